"""Sums that break plain least squares of knowledge (docs/method.md, section 14).

The oracle has 60 digits, or is a change that cannot matter. Errors are those of answers W z,
relative to the largest, unless a case says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mpmath
import numpy as np

from benchmarks.stability.case import Outcome, beside, case
from chebsplat.lifting.averages import averaged
from chebsplat.shape.lessons import (
    RIDGE,
    Sums,
    basis,
    combined,
    novelty,
    odds,
    scale_of,
    solved,
    summed,
    unexplained,
)

N, P, C = 40, 6, 3
ANSWERS = 1e-9  # of float64 sums and a Cholesky of condition 1e3 and less


class Scene(NamedTuple):
    """Features z [N, P], the last of them 1, meanings y [N, C], weights w [N]."""

    features: np.ndarray
    meanings: np.ndarray
    weights: np.ndarray


def scene(seed: int = 0, n: int = N) -> Scene:
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(n, P))
    features[:, -1] = 1
    return Scene(
        features,
        features @ rng.normal(size=(P, C)) + 0.3 * rng.normal(size=(n, C)),
        rng.uniform(0.5, 2, n),
    )


def with_features(change: Callable[[np.ndarray], np.ndarray]) -> Scene:
    of = scene()
    return of._replace(features=np.column_stack([change(of.features[:, :-1]), of.features[:, -1]]))


def with_weights(weights: np.ndarray | float) -> Scene:
    return scene()._replace(weights=scene().weights * weights)


SCENES: dict[str, Callable[[], Scene]] = {
    "one point": lambda: scene(n=1),
    "fewer points than features": lambda: scene(n=3),
    "all points alike": lambda: Scene(*(np.repeat(part[:1], N, 0) for part in scene())),
    "two features alike": lambda: with_features(lambda z: z[:, [0, 0, 1, 2, 3]]),
    "two features alike to 1e-12": lambda: with_features(
        lambda z: z[:, [0, 0, 1, 2, 3]] * (1 + 1e-12 * z)
    ),
    "a feature that is 0": lambda: with_features(lambda z: z * [1, 0, 1, 1, 1]),
    "features of 1e-3 to 1e+2": lambda: with_features(lambda z: z * np.geomspace(1e-3, 1e2, 5)),
    "features of 1e+05": lambda: with_features(lambda z: z * 1e5),
    "features 1e+05 from 0": lambda: with_features(lambda z: z + 1e5),
    "weights of 1e-300": lambda: with_weights(1e-300),
    "weights of 1e+300": lambda: with_weights(1e300),
    "weights of 1e-30 to 1e+30": lambda: with_weights(np.geomspace(1e-30, 1e30, N)),
    "meanings of 1e-30": lambda: scene()._replace(meanings=1e-30 * scene().meanings),
    "meanings of 0": lambda: scene()._replace(meanings=0 * scene().meanings),
}


def exactly(of: Scene) -> np.ndarray:
    """Answers of the scene's own points in 60 digits, straight from the definition."""
    with mpmath.workdps(60):
        z, y, w = (
            mpmath.matrix(np.asarray(part, np.float64).reshape(len(of.weights), -1).tolist())
            for part in of
        )
        total = mpmath.fsum(w)
        weighted = mpmath.matrix(len(of.weights), P)
        for i in range(len(of.weights)):
            weighted[i, :] = z[i, :] * (w[i] / total)
        gram, cross = weighted.T * z, weighted.T * y
        for k in range(P):
            gram[k, k] = gram[k, k] * (1 + mpmath.mpf(RIDGE)) or mpmath.mpf(1)
        return np.array((z * (gram**-1 * cross)).tolist(), np.float64).reshape(len(of.weights), C)


@case("learned, {name}", name=SCENES)
def learned(name: str) -> Outcome:
    """The plain way solves the same equations as they are, in float32."""
    of = SCENES[name]()

    def plainly() -> np.ndarray:
        z, y, w = (part.astype(np.float32) for part in of)
        gram = z.T @ (w[:, None] * z) / w.sum()
        return z @ np.linalg.solve(
            gram + np.float32(RIDGE) * np.diag(np.diag(gram)), z.T @ (w[:, None] * y) / w.sum()
        )

    return beside(of.features @ solved(summed(*of), RIDGE), plainly, exactly(of), ANSWERS)


@case("answers whatever the unit of features, {unit:.0e}", unit=[1e-100, 1e-20, 1e20, 1e100])
def units(unit: float) -> Outcome:
    """As with a unit of 1; the plain way adds the same number to every feature."""
    of = scene()
    sums, features = summed(unit * of.features, of.meanings, of.weights), unit * of.features

    def plainly() -> np.ndarray:
        return features @ np.linalg.solve(sums.gram + RIDGE * np.eye(P), sums.cross)

    return beside(features @ solved(sums, RIDGE), plainly, exactly(of), ANSWERS)


def lessons(count: int) -> list[Sums]:
    return [summed(*scene(seed)) for seed in range(count)]


@case("{count} lessons in any order", count=[2, 1000])
def order(count: int) -> Outcome:
    """W of lessons of weights 1e-15 to 1e15 forwards beside that backwards."""
    weights, sums = (
        list(np.geomspace(1e-15, 1e15, count)),
        lessons(min(count, 20)) * max(count // 20, 1),
    )
    weights = weights[: len(sums)]
    forwards, again = (
        solved(combined(of, by), RIDGE) for of, by in ((sums, weights), (sums[::-1], weights[::-1]))
    )

    def plainly() -> np.ndarray:
        gram = sum(
            np.float32(w) * of.gram.astype(np.float32) for of, w in zip(sums, weights, strict=True)
        )
        cross = sum(
            np.float32(w) * of.cross.astype(np.float32) for of, w in zip(sums, weights, strict=True)
        )
        return np.linalg.solve(gram + np.float32(RIDGE) * np.diag(np.diag(gram)), cross)

    return beside(forwards, plainly, again, ANSWERS)


NOVEL: dict[str, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
    "the same scene": (lambda z: z, 0.0),
    "in units of 1e-100": (lambda z: 1e-100 * z, 0.0),
    "in units of 1e+100": (lambda z: 1e100 * z, 0.0),
    "at right angles to all that is known": (lambda z: z * [0, 0, 0, 1, 1, 1], 1.0),
}


@case("novelty of {name}", name=NOVEL)
def new(name: str) -> Outcome:
    """ρ beside 0 or 1, half of the features being in the basis; ENERGY leaves a tenth of those."""
    change, exact = NOVEL[name]
    of = scene()
    half = of.features * [1, 1, 1, 0, 0, 0]
    first_half = summed(half, of.meanings, of.weights)
    scale = scale_of(summed(*of))
    scene_sums = summed(change(half if exact == 0 else of.features), of.meanings, of.weights)
    return Outcome(abs(novelty(scene_sums, scale, basis(first_half, scale)) - exact), 0.1)


@case("left unexplained, meanings of {size:.0e}", size=[1e-100, 1e-10, 1e10, 1e100])
def left(size: float) -> Outcome:
    """As with meanings of 1; the plain way subtracts squares in float32."""
    of, exact = scene(), summed(*scene())
    sums = summed(of.features, size * of.meanings, of.weights)

    def plainly() -> float:
        y = (size * of.meanings).astype(np.float32)
        missed = y - (of.features @ solved(sums, RIDGE)).astype(np.float32)
        return float((of.weights @ np.square(missed)).sum() / (of.weights @ np.square(y)).sum())

    ours, expected = (unexplained(each, solved(each, RIDGE)) for each in (sums, exact))
    return beside(ours, plainly, expected, ANSWERS)


class Views(NamedTuple):
    """Three views of points [N, 3] on a wall: depth [V, H, W], features [V, h, w, C], poses."""

    means: np.ndarray
    depth: np.ndarray
    features: np.ndarray
    poses: np.ndarray
    unit: float = 1.0


VIEW_K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])


def views(unit: float = 1.0, shift: float = 0.0, size: float = 1.0) -> Views:
    """A wall at z = 2 from places side by side, features f16 as teachers' are kept."""
    rng, poses = np.random.default_rng(4), np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = -unit * np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]) - shift
    points = np.column_stack(
        [rng.uniform(-0.8, 0.9, N), rng.uniform(-0.7, 0.7, N), np.full(N, 2.0)]
    )
    features = (size * rng.uniform(0.25, 1, (3, 24, 32, C))).astype(np.float16)
    return Views(unit * points + shift, np.full((3, 24, 32), unit * 2.0), features, poses, unit)


def blind(value: float) -> Views:
    """A view whose depth is this."""
    of = views()
    of.depth[1] = value
    return of


SEEN: dict[str, Callable[[], Views]] = {
    "in units of 1e-06": lambda: views(1e-6),
    "in units of 1e+06": lambda: views(1e6),
    "1e+06 from the origin": lambda: views(shift=1e6),
    "features of 6e+04": lambda: views(size=6e4),
    "features of 1e-06": lambda: views(size=1e-6),
    "features of 0": lambda: views(size=0.0),
    "a view without depth": lambda: blind(0),
    "a view of NaN": lambda: blind(np.nan),
    "a view of inf": lambda: blind(np.inf),
    "a view that is covered": lambda: blind(1.0),
    "all behind the cameras": lambda: views()._replace(means=views().means * [1, 1, -1]),
    "no point": lambda: views()._replace(means=np.zeros((0, 3))),
}


@case("seen by views, {name}", name=SEEN)
def mean_features(name: str) -> Outcome:
    """Mean unit features of points, point by point; plainly, the mean at their pixels, in f16."""
    of = SEEN[name]()
    exact, plain = np.zeros((len(of.means), C)), np.zeros((len(of.means), C), np.float16)
    for i, point in enumerate(of.means):
        rows = []
        for depth, features, pose in zip(of.depth, of.features, of.poses, strict=True):
            x, y, z = (point + pose[:3, 3]) / of.unit
            column, row = int(np.floor(30 * x / z + 16)), int(np.floor(30 * y / z + 12))
            if not (z > 0 and 0 <= column < 32 and 0 <= row < 24):
                continue
            plain[i] += features[row, column] / np.float16(3)
            feature = features[row, column].astype(np.float64)
            if abs(depth[row, column] / of.unit - z) < 0.03 + 0.01 * z and feature.any():
                rows.append(feature / np.linalg.norm(feature))
        exact[i] = np.mean(rows, 0) if rows else 0
    ours, _ = averaged(
        of.means, of.depth, of.features, C, np.tile(VIEW_K, (3, 1, 1)), of.poses, unit=of.unit
    )
    return beside(ours, lambda: plain, exact, 1e-5)


@case("odds of {n} points, one of a label of its own", n=[2, 1000, 1_000_000])
def rare(n: int) -> Outcome:
    """Odds of that one against the formula."""
    labels, views = np.zeros(n, np.int64), np.full(n, 2)
    labels[-1] = 1
    exact = 0.5 / n + 0.5 / (1 + (n - 1) / np.sqrt(n - 1))
    return Outcome(abs(odds(views, labels)[-1] / exact - 1), ANSWERS)
