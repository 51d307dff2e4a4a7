"""Poses that break the plain way from one world to another (docs/method.md, section 1).

Errors are the largest of that of the scale, of the rotation's entries and of places over the
cameras' spread.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.cameras import centers
from chebsplat.splats.similarity import Similarity, fitted
from chebsplat.stages.reconstruction.adjustment import adjust, alignment, frame
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config

VIEWS = 20
EXACT = 1e-9  # float64 at 1e6 of the cameras' spread
TURN = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()


class Worlds(NamedTuple):
    """Poses [V, 4, 4] of the same cameras in two worlds; way: from the first to the second."""

    first: np.ndarray
    second: np.ndarray
    way: Similarity


def worlds(
    scale: float = 2.5,
    shift: float = 3.0,
    spread: tuple[float, float, float] = (1, 0.8, 0.3),
    at: float = 0.0,
    n: int = VIEWS,
) -> Worlds:
    """Cameras that look everywhere, `at` so far from the first world's origin."""
    rng, first = np.random.default_rng(0), np.tile(np.eye(4), (n, 1, 1))
    first[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    first[:, :3, 3] = -np.einsum(
        "vij,vj->vi", first[:, :3, :3], rng.normal(size=(n, 3)) * spread + at
    )
    way = Similarity(scale, TURN, np.array([1.0, -2.0, 0.5]) * shift)
    return Worlds(first, way.of_cameras(first), way)


def astray(share: float, by: float) -> Worlds:
    """So many of the second poses are moved."""
    of = worlds()
    second = of.second.copy()
    second[: round(share * VIEWS), :3, 3] += by
    return of._replace(second=second)


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


def differ(similarity: Similarity, of: Worlds) -> float:
    """Of scale, rotation, and of places in the second world."""
    there = centers(of.second)
    spread = max(float(np.abs(there - there.mean(0)).max()), 1e-6 * float(np.abs(there).max()))
    apart = np.abs(similarity.of_points(centers(of.first)) - there).max() / spread
    return max(
        relative(similarity.scale, of.way.scale),
        relative(similarity.rotation, of.way.rotation),
        float(apart),
    )


@case("aligned, {name}", name=WORLDS)
def aligned(name: str) -> Outcome:
    """The plain way fits the centres alone, in float32."""
    of = WORLDS[name]()

    def plainly() -> Similarity:
        return fitted(centers(of.first).astype(np.float32), centers(of.second).astype(np.float32))

    tolerance = 1e-8 if "1e+06 from" in name else EXACT  # of places, which float64 rounds by 1e-10
    return beside(Similarity(*alignment(of.first, of.second)), plainly, of, tolerance, differ)


@case("{share:.0%} of the poses astray by {by:.0e}", share=[0.05, 0.3], by=[1.0, 1e6])
def lost(share: float, by: float) -> Outcome:
    """The frame of the others; plainly, of all. ValueError if others than these are left out."""
    of, true = astray(share, by), worlds()
    fit = frame(of.first, of.second, np.ones(VIEWS, bool))
    if not np.array_equal(fit.led, np.arange(VIEWS) >= round(share * VIEWS)):
        raise ValueError(f"{fit.led.sum()} views are believed")
    return beside(
        Similarity(*fit[:3]),
        lambda: Similarity(*alignment(of.first, of.second)),
        true,
        EXACT,
        differ,
    )


def photographed(database: Path) -> pycolmap.Reconstruction:
    """Sixteen views of 300 points, known to half a pixel, whose matches are put into a database."""
    pycolmap.set_random_seed(0)
    options, noise = pycolmap.SyntheticDatasetOptions(), pycolmap.SyntheticNoiseOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 16, 300
    options.camera_model_id, options.camera_params = (
        pycolmap.CameraModelId.PINHOLE,
        [900, 900, 512, 384],
    )
    noise.point2D_stddev = 0.5
    with pycolmap.Database.open(database) as opened:
        model = pycolmap.synthesize_dataset(options, opened)
        pycolmap.synthesize_noise(noise, model, opened)
    return model


def images_of(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted(model.images.values(), key=lambda image: image.name)


def posed(model: pycolmap.Reconstruction) -> np.ndarray:
    """Poses [V, 4, 4] of its images."""
    return np.stack(
        [np.vstack([image.cam_from_world().matrix(), np.eye(4)[3]]) for image in images_of(model)]
    )


ADJUSTED: dict[str, tuple[Similarity, float, float]] = {
    "in units of 1e-03": (Similarity(1e-3, TURN, np.zeros(3)), 0.01, 900.0),
    "in units of 1e+03": (Similarity(1e3, TURN, np.zeros(3)), 0.01, 900.0),
    "1e+03 from the origin": (Similarity(1.0, TURN, np.full(3, 1e3)), 0.01, 900.0),
    "focal lengths off by 5 %": (Similarity(1.0, TURN, np.zeros(3)), 0.01, 945.0),
    "not disturbed": (Similarity(1.0, TURN, np.zeros(3)), 0.0, 900.0),
    "disturbed by 2 %": (Similarity(1.0, TURN, np.zeros(3)), 0.02, 900.0),
}


@case("adjusted to photos, {name}", name=ADJUSTED)
def adjusted(name: str) -> Outcome:
    """Mean distance of centres from the true ones, over their spread; plainly, poses stay."""
    (way, share, focal), rng = ADJUSTED[name], np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as root:
        folder, database = Path(root), Path(root) / "database.db"
        (folder / "images").mkdir()
        model = photographed(database)
        names, exact = [image.name for image in images_of(model)], way.of_cameras(posed(model))
        size = np.linalg.norm(centers(exact) - centers(exact).mean(0), axis=1).mean()
        disturbed = exact.copy()
        turns = Rotation.from_rotvec(0.5 * share * rng.normal(size=(len(names), 3))).as_matrix()
        places = centers(exact) + share * size * rng.normal(size=(len(names), 3))
        disturbed[:, :3, :3] = turns @ exact[:, :3, :3]
        disturbed[:, :3, 3] = -np.einsum("vij,vj->vi", disturbed[:, :3, :3], places)
        job = Job({}, Config(), folder / "out", folder)
        for image, pose in zip(images_of(model), disturbed, strict=True):
            image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose[:3]))
            image.camera.params = [focal, focal, 512, 384]
        refined = posed(adjust(job, model, database, names, disturbed)[0])

    def off(poses: np.ndarray, exact: np.ndarray) -> float:
        there = Similarity(*alignment(poses, exact)).of_points(centers(poses))
        return float(np.linalg.norm(there - centers(exact), axis=1).mean() / size)

    return beside(refined, lambda: disturbed, exact, 2e-3, off)


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
        return np.asarray(
            design @ np.linalg.solve(design.T @ design, design.T @ exact.astype(np.float32))
        )

    spread = np.abs(exact - exact.mean(0)).max()
    ours = fitted(points, exact).of_points(points)
    return beside(ours / spread, lambda: plainly() / spread, exact / spread, EXACT)
