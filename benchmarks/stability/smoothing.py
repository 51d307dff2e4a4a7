"""Gaussians that break plain smoothing; scenes of unclear metre (docs/method.md, section 13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.stability.case import Outcome, beside, case
from chebsplat.lifting import smoothing
from chebsplat.lifting.smoothing import (
    ANGLE,
    COLOR,
    DISTANCE,
    PASSES,
    PLANE,
    REACH,
    affinities,
    room_unit,
    smooth,
)

N = 20  # no more than have all others for neighbours
TOLERANCE = 1e-5  # float32 sums of features, normals of float64
UNIT = 0.25  # as rooms differ


class Cloud(NamedTuple):
    """means, unit normals, colours, features [N, 3], evidence [N]; unit: scene units of a metre."""

    means: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    features: np.ndarray
    evidence: np.ndarray
    unit: float = 1.0


def cloud(n: int = N) -> Cloud:
    """A patch of a wall, 0.4 m wide, of few colours."""
    rng = np.random.default_rng(0)
    normals = rng.normal((0, 0, 3), 1, (n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    means, colors = rng.uniform(0, (0.4, 0.4, 0.02), (n, 3)), rng.uniform(0.4, 0.6, (n, 3))
    return Cloud(means, normals, colors, rng.normal(size=(n, 3)), rng.uniform(1, 9, n))


def changed(**changes: Callable[[np.ndarray], Any]) -> Cloud:
    of = cloud()
    return of._replace(**{name: change(getattr(of, name)) for name, change in changes.items()})


CLOUDS: dict[str, Callable[[], Cloud]] = {
    "none": lambda: cloud(0),
    "one": lambda: cloud(1),
    "two": lambda: cloud(2),
    "pairs": lambda: changed(means=lambda v: np.repeat(v[::2], 2, 0)),
    "all in one place": lambda: changed(means=lambda v: v * 0 + 3),
    "units of 1e-06": lambda: changed(means=lambda v: 1e-6 * v, unit=lambda u: 1e-6),
    "units of 1e+06": lambda: changed(means=lambda v: 1e6 * v, unit=lambda u: 1e6),
    "1e+04 from the origin": lambda: changed(means=lambda v: v + 1e4),
    "1e+07 from the origin": lambda: changed(means=lambda v: v + 1e7),
    "an outlier at 1e+08": lambda: changed(
        means=lambda v: np.where(np.arange(N)[:, None] == 4, 1e8, v)
    ),
    "normals of any sign": lambda: changed(
        normals=lambda v: v * np.where(np.arange(N) % 2, 1, -1)[:, None]
    ),
    "one normal for all": lambda: changed(normals=lambda v: v * 0 + (0, 0, 1)),
    "no evidence": lambda: changed(evidence=lambda e: 0 * e),
    "evidence of 1e-30": lambda: changed(evidence=lambda e: 1e-30 * e),
    "evidence of 1e+30": lambda: changed(evidence=lambda e: 1e30 * e),
    "one Gaussian with evidence": lambda: changed(evidence=lambda e: e * (np.arange(N) == 7)),
    "evidence of 1e-15 to 1e+15": lambda: changed(
        evidence=lambda e: e * np.geomspace(1e-15, 1e15, N)
    ),
    "features of 1e-30": lambda: changed(features=lambda f: 1e-30 * f),
    "features of 1e+30": lambda: changed(features=lambda f: 1e30 * f),
}


def smoothed(of: Cloud, dtype: type) -> np.ndarray:
    """By its formula, over all pairs."""
    means, normals, colors, features, evidence = (part.astype(dtype) for part in of[:5])
    x = (means[None] - means[:, None]) / dtype(of.unit)
    square, across = (x * x).sum(-1), np.einsum("ijd,id->ij", x, normals)
    angles = np.arccos(np.abs(normals @ normals.T).clip(0, 1))
    differ = ((colors[None] - colors[:, None]) ** 2).sum(-1)
    exponent = (
        square / DISTANCE**2 + (across / PLANE) ** 2 + differ / COLOR**2 + (angles / ANGLE) ** 2
    )
    weights = np.where(square <= REACH**2, np.exp(-exponent / 2), 0)
    weights[np.arange(len(x)), np.arange(len(x))] = 1
    total = weights @ evidence
    for _ in range(PASSES):
        mean = (weights @ (evidence[:, None] * features)) / total[:, None]
        features = np.where(total[:, None] > 0, mean, features) if dtype is np.longdouble else mean
    return features


@case("smoothed, {name}", name=CLOUDS)
def smooths(name: str) -> Outcome:
    """Against 80 bits over all pairs."""
    of = CLOUDS[name]()
    ours = smooth(of.features, of.evidence, affinities(of.means, of.normals, of.colors, of.unit))
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = smoothed(of, np.longdouble)
    return beside(ours, lambda: smoothed(of, np.float32), exact, TOLERANCE)


def room(n: int = 2000) -> np.ndarray:
    """Points on the sides of a room of 5 by 4 by 2.6 m."""
    rng, size = np.random.default_rng(0), np.array([5, 4, 2.6])
    means = rng.uniform(0, size, (n, 3))
    side = rng.integers(0, 3, n)
    means[np.arange(n), side] = size[side] * rng.integers(0, 2, n)
    return means


def with_background(share: float, distance: float) -> np.ndarray:
    """The room, and so much of all on one side of it, far away."""
    n = round(2000 * share / (1 - share))
    far = np.random.default_rng(1).normal(size=(n, 3))
    far *= distance / np.linalg.norm(far, axis=1, keepdims=True)
    far[:, 0] = np.abs(far[:, 0])
    return np.concatenate([room(), far])


ROOMS: dict[str, Callable[[], tuple[np.ndarray, float]]] = {
    "as it is": lambda: (room(), 1.0),
    "in units of 1e-3": lambda: (1e-3 * room(), 1e-3),
    "in units of 1e3": lambda: (1e3 * room(), 1e3),
    "1e4 from the origin": lambda: (room() + 1e4, 1.0),
    "of pairs": lambda: (np.repeat(room(), 2, 0), 1.0),
    "with 60 % background at 1e2": lambda: (with_background(0.6, 1e2), 1.0),
    "with 60 % background at 1e4": lambda: (with_background(0.6, 1e4), 1.0),
    "with 70 % background at 1e6": lambda: (with_background(0.7, 1e6), 1.0),
    "with one point at 1e9": lambda: (np.concatenate([room(), [[1e9, 0, 0]]]), 1.0),
    "of one point": lambda: (room(1), 1.0),
    "of no point": lambda: (room(0), 1.0),
    "of points in one place": lambda: (room() * 0, 1.0),
}


@case("the metre of a room {name}", name=ROOMS)
def metre(name: str) -> Outcome:
    """Against the true one; the plain way is the median distance from the median of all."""
    means, unit = ROOMS[name]()

    def plainly() -> float:
        away = np.linalg.norm(means - np.median(means, axis=0), axis=1)
        return float(np.median(away)) / smoothing.HALF_EXTENT

    return beside(room_unit(means), plainly, unit, UNIT)
