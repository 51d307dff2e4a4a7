"""Photos that break plain means of exposures (docs/method.md, section 5). Errors are in stops."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.stability.case import Outcome, beside, case
from chebsplat.photos.exposures import expected_exposures, light_of, measured_exposures, relit

HEIGHT, WIDTH, VIEWS, N = 60, 80, 6, 400
K = np.array([[70.0, 0, WIDTH / 2], [0, 70.0, HEIGHT / 2], [0, 0, 1]])
STOPS = 0.03  # bytes of dark photos
ALIKE = 1e-6


class Photos(NamedTuple):
    """images u8 [V, H, W, 3], poses [V, 4, 4], points [N, 3], and the exact exposures [V, 3]."""

    images: np.ndarray
    poses: np.ndarray
    points: np.ndarray
    exact: np.ndarray


def photos(
    stops: np.ndarray | float = 0.0,
    unit: float = 1.0,
    shift: float = 0.0,
    n: int = N,
    views: int = VIEWS,
) -> Photos:
    """A wall of broad stripes at z = 3, from places side by side; stops [V, 3]."""
    exact = np.broadcast_to(stops, (views, 3)) - np.broadcast_to(stops, (views, 3)).mean(0)
    x = np.arange(WIDTH)[None, :, None]
    poses, images, rng = np.tile(np.eye(4), (views, 1, 1)), [], np.random.default_rng(0)
    for view, of in enumerate(np.broadcast_to(stops, (views, 3))):
        place = 2 * view  # pixels
        light = 0.12 + 0.05 * np.sin((x + place) / 9.0 + np.arange(3)) + np.zeros((HEIGHT, 1, 1))
        lit = np.minimum(light * 2.0**of, 1)
        images.append(
            (
                255 * np.where(lit <= 0.0031308, 12.92 * lit, 1.055 * lit ** (1 / 2.4) - 0.055)
            ).round()
        )
        poses[view, :3, 3] = -unit * np.array([place * 3 / 70, 0, 0]) - shift
    points = np.column_stack([rng.uniform(-1, 1.6, n), rng.uniform(-0.8, 0.8, n), np.full(n, 3.0)])
    return Photos(np.array(images, np.uint8), poses, unit * points + shift, exact)


STEPS = np.random.default_rng(1).uniform(-1, 1, (VIEWS, 3))


def spoiled(change: Callable[[np.ndarray], object]) -> Photos:
    of = photos(STEPS)
    change(of.images)
    return of


def lost(of: Photos, views: slice) -> Photos:
    """The exact exposures where these views show none."""
    exact = of.exact.copy()
    exact[views] = np.nan
    return of._replace(exact=exact - np.nanmean(exact, 0) if np.isfinite(exact).any() else exact)


TAKEN: dict[str, Callable[[], Photos]] = {
    "alike": photos,
    "two stops apart": lambda: photos(STEPS),
    "four stops apart": lambda: photos(2 * STEPS),
    "units of 1e-02": lambda: photos(STEPS, 1e-2),
    "units of 1e+06": lambda: photos(STEPS, 1e6),
    "1e+06 from the origin": lambda: photos(STEPS, shift=1e6),
    "two views": lambda: photos(STEPS[:2], views=2),
    "one view": lambda: lost(photos(views=1), np.s_[:]),
    "29 points": lambda: lost(photos(n=29), np.s_[:]),
    "no points": lambda: lost(photos(n=0), np.s_[:]),
    "one photo black": lambda: lost(spoiled(lambda v: v[2].fill(0)), np.s_[2]),
    "one photo white": lambda: lost(spoiled(lambda v: v[2].fill(255)), np.s_[2]),
    "all photos black": lambda: lost(spoiled(lambda v: v.fill(0)), np.s_[:]),
    "a third of one photo covered": lambda: spoiled(lambda v: v[2, :, : WIDTH // 3].fill(120)),
    "highlights in all photos": lambda: spoiled(lambda v: v[:, :, ::40].fill(255)),
}


def in_stops(ours: np.ndarray, exact: np.ndarray) -> float:
    """The largest difference; inf where one tells and the other does not."""
    if not np.array_equal(np.isnan(ours), np.isnan(exact)):
        return float("inf")
    return float(np.nanmax(np.abs(ours - exact), initial=0.0))


@case("photos, {name}", name=TAKEN)
def exposures(name: str) -> Outcome:
    """The plain way takes the logarithm of each photo's mean light."""
    images, poses, points, exact = TAKEN[name]()
    ours = measured_exposures(images, np.tile(K, (len(images), 1, 1)), poses, points)

    def plainly() -> np.ndarray:
        light = np.log2(light_of(images / 255).mean((1, 2)))
        return np.asarray(light - light.mean(0))

    return beside(ours, plainly, exact, STOPS, in_stops)


def path(n: int = 24, unit: float = 1.0) -> np.ndarray:
    """Poses along a line, all looking the same way."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = -unit * np.arange(n)
    return poses


DRIFT = np.linspace(-1, 1, 24)[:, None] * [1.0, 1, 1]
# exposures, poses, and what is to be expected at these
EXPECTED: dict[str, Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    "exposures of 0": lambda: (0 * DRIFT, path(), 0 * DRIFT),
    "exposures of 1e+30": lambda: (0 * DRIFT + 1e30, path(), 0 * DRIFT + 1e30),
    "a drift along the path": lambda: (DRIFT, path(), DRIFT),
    "a drift of 1e-06": lambda: (1e-6 * DRIFT, path(), 1e-6 * DRIFT),
    "a drift, units of 1e-12": lambda: (DRIFT, path(unit=1e-12), DRIFT),
    "a drift, units of 1e+12": lambda: (DRIFT, path(unit=1e12), DRIFT),
    "two views": lambda: (DRIFT[:2], path(2), 0 * DRIFT[:2]),
    "no view known": lambda: (DRIFT + np.nan, path(), 0 * DRIFT),
    "half of the views known": lambda: (
        DRIFT * np.where(np.arange(24) % 2, 1, np.nan)[:, None],
        path(),
        DRIFT,
    ),
}


@case("what exposure a photo may be expected to have, {name}", name=EXPECTED)
def expected(name: str) -> Outcome:
    """What changes along a path is expected; the plain way takes the mean of all."""
    exposures, poses, exact = EXPECTED[name]()

    def differs(ours: np.ndarray, exact: np.ndarray) -> float:
        worst = float(np.abs(ours - exact).max()) / (float(np.abs(exact).max(initial=0)) or 1)
        return worst if np.isfinite(ours).all() else float("inf")

    return beside(
        expected_exposures(exposures, poses, poses),
        lambda: np.full_like(exact, exposures.mean()),
        exact,
        0.05,
        differs,
    )


@case("what exposure to expect, views at one place, {size:.0e} stops", size=[1e-6, 1.0, 1e6])
def one_place(size: float) -> Outcome:
    """Their mean, to a part of their spread: no view lies between others."""
    exposures = size * np.random.default_rng(0).normal(size=(24, 3))
    ours, exact = expected_exposures(exposures, path(unit=0.0), path(unit=0.0)), exposures.mean(0)
    return Outcome(float(np.abs(ours - exact).max() / np.abs(exposures).max()), 0.02)


@case("a photo relit by {stops:g} stops", stops=[0.0, 60.0, -60.0, 1000.0, -1000.0])
def lit(stops: float) -> Outcome:
    """As it was, white but for black, or black."""
    image = np.arange(256, dtype=np.uint8)[:, None, None].repeat(3, 2)
    exact = image if stops == 0 else np.where((image > 0) & (stops > 0), 255, 0)
    return Outcome(float(np.abs(relit(image, np.full(3, stops)) - exact.astype(float)).max()), 0.0)
