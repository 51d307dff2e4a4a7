"""Poses that break the plain way from one world to another, as adjusted poses go (docs/method.md,
section 1).

Errors are the largest of that of the scale, of the rotation's entries and of places over the
cameras' spread.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.cameras import centers, common_up, upright
from chebsplat.splats.similarity import Similarity, fitted, turned_light
from chebsplat.stages.reconstruction.adjustment import alignment, frame

VIEWS = 20
EXACT = 1e-9  # float64 at 1e6 of the cameras' spread
TURN = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()


class Worlds(NamedTuple):
    """Poses [V, 4, 4] of the same cameras in two worlds, and the similarity from the first to the
    second.
    """

    found: np.ndarray
    given: np.ndarray
    way: Similarity


def worlds(
    scale: float = 2.5,
    shift: float = 3.0,
    spread: tuple[float, float, float] = (1, 0.8, 0.3),
    at: float = 0.0,
    n: int = VIEWS,
) -> Worlds:
    """Cameras that look everywhere, `at` so far from the first world's origin."""
    rng, found = np.random.default_rng(0), np.tile(np.eye(4), (n, 1, 1))
    found[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    found[:, :3, 3] = -np.einsum("vij,vj->vi", found[:, :3, :3], rng.normal(size=(n, 3)) * spread + at)
    way = Similarity(scale, TURN, np.array([1.0, -2.0, 0.5]) * shift)
    return Worlds(found, way.of_cameras(found), way)


def astray(share: float, by: float) -> Worlds:
    """So many of the given poses are moved."""
    of = worlds()
    given = of.given.copy()
    given[: round(share * VIEWS), :3, 3] += by
    return of._replace(given=given)


def one_place() -> Worlds:
    """Nothing tells a scale: it stays."""
    return worlds(1.0, spread=(0, 0, 0), at=2.0)


WORLDS: dict[str, Callable[[], Worlds]] = {
    "scale 1e-06": lambda: worlds(1e-6, shift=1e-6),
    "scale 1e+06": lambda: worlds(1e6),
    "shift 1e+06": lambda: worlds(shift=1e6),
    "1e+06 from the origin": lambda: worlds(at=1e6),
    "cameras on a line": lambda: worlds(spread=(1, 0, 0)),
    "cameras on a line, nearly": lambda: worlds(spread=(1, 1e-9, 1e-9)),
    "cameras in a plane": lambda: worlds(spread=(1, 1, 0)),
    "cameras in one place": one_place,
    "two cameras": lambda: worlds(n=2),
    "one camera": lambda: worlds(1.0, n=1),
}


def differ(found: Similarity, of: Worlds) -> float:
    """Of scale, rotation, and of places in the second world."""
    there = centers(of.given)
    spread = max(float(np.abs(there - there.mean(0)).max()), 1e-6 * float(np.abs(there).max()))
    apart = np.abs(found.of_points(centers(of.found)) - there).max() / spread
    return max(relative(found.scale, of.way.scale), relative(found.rotation, of.way.rotation), float(apart))


@case("aligned, {name}", name=WORLDS)
def aligned(name: str) -> Outcome:
    """The plain way fits the centres alone, in float32."""
    of = WORLDS[name]()

    def plainly() -> Similarity:
        return fitted(centers(of.found).astype(np.float32), centers(of.given).astype(np.float32))

    tolerance = 1e-8 if "1e+06 from" in name else EXACT  # of places, which float64 rounds by 1e-10
    return beside(Similarity(*alignment(of.found, of.given)), plainly, of, tolerance, differ)


@case("{share:.0%} of the poses astray by {by:.0e}", share=[0.05, 0.15], by=[1.0, 1e6])
def lost(share: float, by: float) -> Outcome:
    """The frame of the others; the plain way aligns all. Raises ValueError where others than these
    are left out.
    """
    of, true = astray(share, by), worlds()
    found = frame(of.found, of.given, np.ones(VIEWS, bool))
    if not np.array_equal(found.led, np.arange(VIEWS) >= round(share * VIEWS)):
        raise ValueError(f"{found.led.sum()} views are believed")
    return beside(Similarity(*found[:3]), lambda: Similarity(*alignment(of.found, of.given)), true, EXACT, differ)


POINTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "in a plane": lambda p: p * [1, 1, 0],
    "on a line": lambda p: p * [1, 0, 0],
    "three of them": lambda p: p[:3],
    "in units of 1e-06": lambda p: 1e-6 * p,
    "in units of 1e+06": lambda p: 1e6 * p,
    "1e+05 from the origin": lambda p: p + 1e5,
}


@case("fitted to points {name}", name=POINTS)
def fits(name: str) -> Outcome:
    """Points there, over their spread; the plain way solves for an affine map."""
    points = POINTS[name](np.random.default_rng(0).normal(size=(30, 3)))
    exact = Similarity(2.5, TURN, np.array([1.0, -2.0, 0.5])).of_points(points)

    def plainly() -> np.ndarray:
        design = np.column_stack([points, np.ones(len(points))]).astype(np.float32)
        return np.asarray(design @ np.linalg.solve(design.T @ design, design.T @ exact.astype(np.float32)))

    spread = np.abs(exact - exact.mean(0)).max()
    found = fitted(points, exact).of_points(points)
    return beside(found / spread, lambda: plainly() / spread, exact / spread, EXACT)


@case("there and back by a scale of {scale:.0e}", scale=[1e-9, 1e-3, 1e3, 1e9])
def back(scale: float) -> Outcome:
    """Points, and Gaussians' light, whose coefficients are turned there and back."""
    way, points = Similarity(scale, TURN, np.array([5.0, 6, 7])), np.random.default_rng(0).normal(size=(30, 3))
    whole = way.inverse().after(way)
    light = turned_light(TURN.T) @ turned_light(TURN)
    return Outcome(max(relative(whole.of_points(points), points), relative(light, np.eye(15))), 1e-6)


@case("up of cameras rolled by {degrees} degrees, {n} views", degrees=[0, 180], n=[1, 2, 500])
def ups(degrees: float, n: int) -> Outcome:
    """Of cameras that turn about z, which is up, or down where all hang over; of one view nothing
    is sure.
    """
    poses = np.tile(np.eye(4), (n, 1, 1))
    turns = Rotation.from_euler("z", np.linspace(0, 2, n)[:, None]).as_matrix()
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses[:, :3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ level @ turns
    up, sure = common_up(poses)
    exact = np.array([0, 0, -1.0 if degrees else 1.0])
    return Outcome(sure if n == 1 else max(relative(up, exact), 1 - sure), EXACT)


@case("upright of {length:.0e}", length=[1e-150, 1e150])
def turns(length: float) -> Outcome:
    """A rotation that brings up to z."""
    up = np.array([0.3, -0.8, 0.2])
    turn = upright(length * up)
    errors = relative(turn @ turn.T, np.eye(3)), relative(turn @ up / np.linalg.norm(up), [0, 0, 1])
    return Outcome(max(errors), EXACT)
