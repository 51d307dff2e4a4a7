"""Sums that break plain least squares of knowledge (docs/method.md, section 14): in 60 digits, or
by what cannot matter.

Errors are those of answers W z, relative to the largest, unless a case says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mpmath
import numpy as np

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.shape.lessons import RIDGE, Sums, basis, combined, novelty, odds, scale_of, solved, summed, unexplained

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
    return Scene(features, features @ rng.normal(size=(P, C)) + 0.3 * rng.normal(size=(n, C)), rng.uniform(0.5, 2, n))


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
    "two features alike to 1e-12": lambda: with_features(lambda z: z[:, [0, 0, 1, 2, 3]] * (1 + 1e-12 * z)),
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
        z, y, w = (mpmath.matrix(np.asarray(part, np.float64).reshape(len(of.weights), -1).tolist()) for part in of)
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
        return z @ np.linalg.solve(gram + np.float32(RIDGE) * np.diag(np.diag(gram)), z.T @ (w[:, None] * y) / w.sum())

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
    weights, sums = list(np.geomspace(1e-15, 1e15, count)), lessons(min(count, 20)) * max(count // 20, 1)
    weights = weights[: len(sums)]
    found, again = (solved(combined(of, by), RIDGE) for of, by in ((sums, weights), (sums[::-1], weights[::-1])))

    def plainly() -> np.ndarray:
        gram = sum(np.float32(w) * of.gram.astype(np.float32) for of, w in zip(sums, weights, strict=True))
        cross = sum(np.float32(w) * of.cross.astype(np.float32) for of, w in zip(sums, weights, strict=True))
        return np.linalg.solve(gram + np.float32(RIDGE) * np.diag(np.diag(gram)), cross)

    return beside(found, plainly, again, ANSWERS)


@case("a scene in {parts} parts", parts=[2, 40])
def in_parts(parts: int) -> Outcome:
    """Sums of parts by their weights, beside the sums of all."""
    of = scene()
    pieces = [Scene(*(part[k::parts] for part in of)) for k in range(parts)]
    shares = [float(piece.weights.sum() / of.weights.sum()) for piece in pieces]
    whole, again = summed(*of), combined([summed(*piece) for piece in pieces], shares)
    return Outcome(max(relative(b, a) for a, b in zip(whole, again, strict=True)), ANSWERS)


NOVEL: dict[str, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
    "the same scene": (lambda z: z, 0.0),
    "in units of 1e-100": (lambda z: 1e-100 * z, 0.0),
    "in units of 1e+100": (lambda z: 1e100 * z, 0.0),
    "at right angles to all that is known": (lambda z: z * [0, 0, 0, 1, 1, 1], 1.0),
}


@case("novelty of {name}", name=NOVEL)
def new(name: str) -> Outcome:
    """ρ beside 0 or 1, where half of the features are known alone; of a scene that is known, ENERGY
    leaves a tenth.
    """
    change, exact = NOVEL[name]
    of = scene()
    half = of.features * [1, 1, 1, 0, 0, 0]
    seen = summed(half, of.meanings, of.weights)
    scale = scale_of(summed(*of))
    given = summed(change(half if exact == 0 else of.features), of.meanings, of.weights)
    return Outcome(abs(novelty(given, scale, basis(seen, scale)) - exact), 0.1)


@case("left unexplained, meanings of {size:.0e}", size=[1e-100, 1e-10, 1e10, 1e100])
def left(size: float) -> Outcome:
    """As with meanings of 1; the plain way subtracts squares in float32."""
    of, exact = scene(), summed(*scene())
    sums = summed(of.features, size * of.meanings, of.weights)

    def plainly() -> float:
        y = (size * of.meanings).astype(np.float32)
        missed = y - (of.features @ solved(sums, RIDGE)).astype(np.float32)
        return float((of.weights @ np.square(missed)).sum() / (of.weights @ np.square(y)).sum())

    found, wanted = (unexplained(each, solved(each, RIDGE)) for each in (sums, exact))
    return beside(found, plainly, wanted, ANSWERS)


@case("odds of {n} points, one of a label of its own", n=[2, 1000, 1_000_000])
def rare(n: int) -> Outcome:
    """That one's odds against the formula."""
    labels, views = np.zeros(n, np.int64), np.full(n, 2)
    labels[-1] = 1
    exact = 0.5 / n + 0.5 / (1 + (n - 1) / np.sqrt(n - 1))
    return Outcome(abs(odds(views, labels)[-1] / exact - 1), ANSWERS)
