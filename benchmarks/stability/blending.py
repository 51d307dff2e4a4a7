"""Blends of views with knowledge of shape that break the plain way (docs/method.md, section 13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.stability.case import Outcome, beside, case
from chebsplat.lifting.blend import (
    AGREED,
    ALIKE,
    SURE,
    blend,
    confidence,
    effective,
    halves_agree,
    reliable,
)
from chebsplat.lifting.observations import LEAST_COSINE, N_POINTS, NEAR, carry

N, C = 30, 4
TOLERANCE = 1e-5  # float32 results


class Parts(NamedTuple):
    """Parts of a blend: features and knowledge [N, C], evidence [N], and the strength."""

    features: np.ndarray
    evidence: np.ndarray
    knowledge: np.ndarray
    strength: float = 2.0


def parts(
    feature: Any = 1.0, evidence: Any = 1.0, length: Any = 1.0, strength: float = 2.0
) -> Parts:
    """Noise; length: of the knowledge."""
    rng = np.random.default_rng(0)
    knowledge = rng.normal(size=(N, C))
    knowledge *= (np.broadcast_to(length, N) / np.linalg.norm(knowledge, axis=1))[:, None]
    return Parts(
        (feature * rng.normal(size=(N, C))).astype(np.float32),
        (evidence * rng.uniform(1, 5, N)).astype(np.float32),
        knowledge.astype(np.float32),
        strength,
    )


WIDE, SOME = np.geomspace(1e-15, 1e15, N), np.arange(N) % 2
BLENDS: dict[str, Callable[[], Parts]] = {
    "no evidence": lambda: parts(evidence=0.0),
    "no evidence and nothing known": lambda: parts(evidence=0.0, length=0.0),
    "no evidence of half, half known": lambda: parts(evidence=SOME, length=SOME),
    "strength 0": lambda: parts(strength=0.0),
    "strength 1e-30": lambda: parts(strength=1e-30),
    "strength 1e+30": lambda: parts(strength=1e30),
    "evidence of 1e-30": lambda: parts(evidence=1e-30),
    "evidence of 1e+30": lambda: parts(evidence=1e30),
    "evidence of 1e-15 to 1e+15": lambda: parts(evidence=WIDE),
    "knowledge of length 1e-12": lambda: parts(length=1e-12),
    "knowledge of length 1e+15": lambda: parts(length=1e15),
    "features of 1e-30": lambda: parts(feature=1e-30),
    "features of 1e+30": lambda: parts(feature=1e30),
}


def blended(of: Parts, dtype: type) -> np.ndarray:
    f, e, g = (part.astype(dtype) for part in of[:3])
    k = dtype(of.strength) * np.sqrt((g * g).sum(1)).clip(0, 1) ** SURE
    mean = (e[:, None] * f + k[:, None] * g) / (e + k)[:, None]
    return np.where(k[:, None] > 0, mean, f) if dtype is np.longdouble else mean


@case("a blend, {name}", name=BLENDS)
def blends(name: str) -> Outcome:
    """Against 80 bits."""
    of = BLENDS[name]()
    with np.errstate(invalid="ignore", divide="ignore"):
        exact = blended(of, np.longdouble)
    return beside(blend(*of), lambda: blended(of, np.float32), exact, TOLERANCE)


@case(
    "how sure a blend is of features of {size:.0e} by {views:.0e} views",
    size=[0.0, 1e-30, 1e30],
    views=[0.0, 2e9],
)
def sure(size: float, views: float) -> Outcome:
    """Against 80 bits."""
    of, n = parts(size), np.full(N, views).astype(np.int64)

    def surely(dtype: type) -> np.ndarray:
        f, g = (part.astype(dtype) for part in (of.features, of.knowledge))
        e = n.astype(dtype) / (1 + dtype(ALIKE) * np.maximum(n - 1, 0))
        k = dtype(of.strength) * np.ones(N, dtype)
        lengths = np.sqrt((f * f).sum(1))
        direction_of_shape = g / np.sqrt((g * g).sum(1))[:, None]
        direction = (
            f / (np.where(lengths > 0, lengths, 1) if dtype is np.longdouble else lengths)[:, None]
        )
        summed = e[:, None] * direction + k[:, None] * direction_of_shape
        return np.asarray(np.sqrt((summed * summed).sum(1)) / (e + 1 + k))

    ours = confidence(of.features, n, np.ones(N), of.knowledge, of.strength)
    return beside(ours, lambda: surely(np.float32), surely(np.longdouble), TOLERANCE)


@case("what views count for, halves of {size:.0e}", size=[0.0, 1e-30, 1e-10, 1e10, 1e30])
def halves(size: float) -> Outcome:
    """ρ⁶ n′ against 80 bits; of halves that say nothing it is 0."""
    rng, n = np.random.default_rng(0), np.array([[1, 2, 10**9]] * (N // 3)).ravel()
    both = (size * (rng.normal(size=(2, N, C)) + 2)).astype(np.float32)

    def counted(dtype: type) -> np.ndarray:
        a, b = both.astype(dtype)
        lengths = np.sqrt((a * a).sum(1)) * np.sqrt((b * b).sum(1))
        cosines = (a * b).sum(1) / (
            np.where(lengths > 0, lengths, 1) if dtype is np.longdouble else lengths
        )
        return np.asarray(cosines.clip(0, 1) ** AGREED * n / (1 + dtype(ALIKE) * (n - 1)))

    ours = reliable(both, np.ones((2, N))) * effective(n)
    return beside(ours, lambda: counted(np.float32), counted(np.longdouble), TOLERANCE)


@case("halves agree alike for features of {size:.0e}", size=[1e-30, 1e-10, 1e10, 1e30])
def compare_halves(size: float) -> Outcome:
    """Agreement of the halves as for features of 1, which only directions tell."""
    rng = np.random.default_rng(0)
    both, n = (rng.normal(size=(2, N, C)) + 1).astype(np.float32), np.full((2, N), 3)

    def agreement(dtype: type, size: float) -> float:
        return halves_agree((size * both).astype(dtype), n)

    def plainly() -> float:
        a, b = (np.float32(size) * both).astype(np.float32)
        return float(np.mean((a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1))))

    return beside(agreement(np.float32, size), plainly, agreement(np.float64, 1.0), TOLERANCE)


class PointValues(NamedTuple):
    """values at points with normals, for means with normals; unit: scene units of a metre."""

    values: np.ndarray
    points: np.ndarray
    point_normals: np.ndarray
    means: np.ndarray
    normals: np.ndarray
    unit: float = 1.0


def point_values(
    n_points: int = 40, units: float = 1.0, shift: float = 0.0, far: float = 0.0
) -> PointValues:
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(n_points + N, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = units * rng.uniform(0, 1, (n_points + N, 3)) + shift
    places[n_points:, 0] += far
    of = (
        rng.normal(size=(n_points, C)),
        places[:n_points],
        normals[:n_points],
        places[n_points:],
        normals[n_points:],
    )
    return PointValues(*of, units)


CARRIED: dict[str, Callable[[], PointValues]] = {
    "1 point": lambda: point_values(1),
    "2 points": lambda: point_values(2),
    "units of 1e-06": lambda: point_values(units=1e-6),
    "units of 1e+06": lambda: point_values(units=1e6),
    "1e+04 from the origin": lambda: point_values(shift=1e4),
    "1e+08 from the origin": lambda: point_values(shift=1e8),
    "Gaussians 1e+08 away": lambda: point_values(far=1e8),
    "Gaussians at the points": lambda: point_values()._replace(means=point_values().points[:N]),
    "points in one place": lambda: point_values(3)._replace(points=np.full((3, 3), 0.5)),
    "normals at right angles": lambda: point_values()._replace(
        point_normals=np.eye(3)[[0] * 40], normals=np.eye(3)[[1] * N]
    ),
    "values of 1e-30": lambda: point_values()._replace(values=1e-30 * point_values().values),
    "values of 1e+30": lambda: point_values()._replace(values=1e30 * point_values().values),
}


def carried(of: PointValues, dtype: type) -> np.ndarray:
    values, points, theirs, means, normals = (part.astype(dtype) for part in of[:5])
    square = (((means[:, None] - points[None]) / dtype(of.unit)) ** 2).sum(-1)
    near = np.argsort(square, 1, kind="stable")[:, :N_POINTS]
    facing = np.abs(np.take_along_axis(normals @ theirs.T, near, 1)).clip(LEAST_COSINE, 1)
    weights = facing**2 / (np.take_along_axis(square, near, 1) + NEAR**2)
    return np.asarray((weights[..., None] * values[near]).sum(1) / weights.sum(1)[:, None])


@case("carried to Gaussians, {name}", name=CARRIED)
def carries(name: str) -> Outcome:
    """Against 80 bits over all points."""
    of = CARRIED[name]()
    ours, _ = carry(*of)
    return beside(ours, lambda: carried(of, np.float32), carried(of, np.longdouble), TOLERANCE)
