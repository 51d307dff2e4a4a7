"""Unit of a source's depth, checked against its poses and fitted where it is another.

Tools write depth in millimetres beside poses in a reconstruction's own unit, in parts of 5000, or
as a network's inverse depth. One scale, or one scale and shift of inverse depth, puts the surface
where a source's points, or other views, have it; depth that agrees is left as it is.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from chebsplat.cameras import centers
from chebsplat.errors import DataFailure

N_PAIRS, N_PIXELS = 300, 20  # pairs of views whose depths are compared, and pixels of each
NEAREST = 0.25  # of the views, among which the other of a pair is drawn: it should see the same
N_POINTS = 100_000  # pairs of a point and a view that are compared
# such pixels that a verdict needs, and the share of them that a unit must compare
LEAST, COMPARED = 500, 0.1
SAME = 0.03  # of its depth, within which two depths agree
# of the share that agrees in the best unit: depth of which so many agree as it is stays so
FITS = 0.95
# that must agree in some unit; and their odds over those at the ends of all units
LEAST_SHARE, OVER_CHANCE = 0.25, 3.0
BASELINES = 0.03, 100.0  # range of depth, in distances of cameras
DOUBTED = 0.5  # share that agrees, below which there is a note
INVERSE = 1.1  # times the share that agrees in any unit, which inverse depth needs
# ln of far to near of inverse depth: less is a wall, whose depth any unit fits from afar
LEAST_RATIO = 0.4
# times the range of all others, and share of pixels, that make a value a code for unknown
FAR, FREQUENT = 2.0, 1e-3


class Unit(NamedTuple):
    """A unit of stored depth v: z = slope v, or, of inverse depth, 1 / z = slope v + shift."""

    slope: float
    shift: float = 0.0
    inverse: bool = False

    def depth(self, stored: np.ndarray) -> np.ndarray:
        """z, nan where inverse depth is not positive."""
        if not self.inverse:
            return np.asarray(self.slope * stored)
        value = self.slope * stored + self.shift
        return np.asarray(1.0 / np.where(value > 0, value, np.nan))


class Evidence(Protocol):
    """Stored depths [N] that can be compared, and their range in scene units."""

    stored: np.ndarray
    between: tuple[float, float]

    def misses(self, unit: Unit) -> np.ndarray:
        """|z / z' - 1| of the pixels that can be compared in this unit, at most N."""


class AtPoints:
    """Depth at the pixels of the source's points, against these; occluded ones disagree.

    Args: points [P, 3] scene units; tracks [T, 2] (point, view); none: every view that has the
      point inside.
    """

    def __init__(self, fields: dict[str, Any], points: np.ndarray, tracks: np.ndarray) -> None:
        n_views, height, width = fields["depth"].shape
        rng, count = np.random.default_rng(0), len(tracks) or len(points) * n_views
        pairs = np.arange(count) if count <= N_POINTS else rng.integers(0, count, N_POINTS)
        point, view = tracks[pairs].T if len(tracks) else (pairs // n_views, pairs % n_views)
        poses = fields["cam_from_world"][view]
        at = (
            np.einsum("nij,nj->ni", poses[:, :3, :3], points[point].astype(np.float64))
            + poses[:, :3, 3]
        )
        pixels, inside = project_into(at, fields["Ks"][view], (width, height))
        stored = fields["depth"][view[inside], pixels[:, 1], pixels[:, 0]]
        valid = stored > 0  # nan is unknown
        self.stored, self.z = stored[valid].astype(np.float64), at[inside, 2][valid]
        low, high = np.quantile(self.z, (0.001, 0.999)) if len(self.z) else (1.0, 1.0)
        self.between = float(low), float(high)

    def misses(self, unit: Unit) -> np.ndarray:
        return np.asarray(np.abs(unit.depth(self.stored) / self.z - 1))


class BetweenViews:
    """Depth at pixels of one view against another view's there."""

    def __init__(self, fields: dict[str, Any]) -> None:
        self.depth = fields["depth"]
        n_views, height, width = self.depth.shape
        rng, poses, Ks = np.random.default_rng(0), fields["cam_from_world"], fields["Ks"]
        eyes, axes = centers(poses), poses[:, 2, :3]
        away = cdist(eyes, eyes)
        away = away / max(float(np.median(away)), 1e-30) + np.arccos((axes @ axes.T).clip(-1, 1))
        one = rng.integers(0, n_views, N_PAIRS)
        rank = rng.integers(1, max(int(NEAREST * n_views), 4), N_PAIRS)
        two = np.argsort(away, axis=1)[one, rank % n_views]
        one, self.other = np.repeat([one, two], N_PIXELS, axis=1)
        column, row = (rng.integers(0, side, len(one)) for side in (width, height))
        self.stored = self.depth[one, row, column].astype(np.float64)
        usable = (one != self.other) & (self.stored > 0)
        one, self.other, self.stored = one[usable], self.other[usable], self.stored[usable]
        image = np.stack([column[usable] + 0.5, row[usable] + 0.5, np.ones(len(one))], 1)
        motions = poses[self.other] @ np.linalg.inv(poses)[one]
        self.rays = np.einsum("nij,njk,nk->ni", motions[:, :3, :3], np.linalg.inv(Ks)[one], image)
        self.offsets, self.Ks = motions[:, :3, 3], Ks[self.other]
        baseline = np.median(np.linalg.norm(self.offsets, axis=1)) if len(one) else 0.0
        self.between = float(baseline * BASELINES[0]), float(baseline * BASELINES[1])

    def misses(self, unit: Unit) -> np.ndarray:
        at = unit.depth(self.stored)[:, None] * self.rays + self.offsets
        height, width = self.depth.shape[1:]
        pixels, inside = project_into(at, self.Ks, (width, height))
        there = self.depth[self.other[inside], pixels[:, 1], pixels[:, 0]].astype(np.float64)
        valid = there > 0
        return np.asarray(np.abs(unit.depth(there[valid]) / at[inside, 2][valid] - 1))


def project_into(
    at: np.ndarray, Ks: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels i64 [M, 2] (column, row) of those points [N, 3] of cameras [N, 3, 3] that lie in an
    image of this (width, height), and their mask [N].
    """
    image = np.einsum("nij,nj->ni", Ks, at)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        where = image[:, :2] / image[:, 2:]
    inside = (at[:, 2] > 0) & (where >= 0).all(1) & (where < np.array(size)).all(1)
    return np.floor(where[inside]).astype(np.int64), inside


def fit(fields: dict[str, Any], where: Path) -> None:
    """Bring the depth of a capture's fields into the unit of its poses, with a note.

    Args: where: the source's folder. Fields: `landmarks`, points and tracks for this check alone,
      where the source has any; else its `points`; else the views' depths are compared with one
      another.
    Raises:  DataFailure naming the folder where the depth fits in no unit.
    Choices: candidates are units from depths nearer than the distance of cameras to far beyond,
      scored by the share of pixels that agree within SAME; the best is refined to the least mean
      error, clipped at a third of SAME. Depth is left as it is where too few pixels can be
      compared, and where hardly more agree in any other unit. It fits in no unit where no more
      agree than at a depth far beyond, where all surfaces look alike.
    """
    notes, landmarks = fields["source"]["notes"], fields.pop("landmarks", None)
    notes += [
        f"Depth of {code:g} stands for unknown, in {share:.1%} of pixels."
        for code, share in codes(fields)
    ]
    if fields.get("cam_from_world") is None:
        return
    evidence = evidence_of(fields, landmarks or fields)
    if (
        min(len(evidence.stored), np.isfinite(fields["depth"]).sum()) < LEAST
        or not evidence.between[0] > 0
    ):
        return
    units = scales(evidence)
    shares = [agreeing(evidence, unit) for unit in units]
    as_it_is, most, chance = agreeing(evidence, Unit(1.0)), max(shares), max(shares[0], shares[-1])
    if most == 0:
        return
    if as_it_is >= max(FITS * most, LEAST_SHARE):
        if as_it_is < DOUBTED:
            notes.append(
                f"Only {as_it_is:.0%} of the depth's pixels agree with {against(evidence)} within "
                f"{SAME:.0%}; ingest.depth=off leaves it out."
            )
        return
    unit = refined(evidence, units[int(np.argmax(shares))])
    if tried := inverses(evidence):
        inverse = refined(evidence, max(tried, key=lambda unit: agreeing(evidence, unit, 3 * SAME)))
        unit = inverse if agreeing(evidence, inverse) > INVERSE * agreeing(evidence, unit) else unit
    share = agreeing(evidence, unit)
    if share < LEAST_SHARE or share * (1 - chance) < OVER_CHANCE * chance * (1 - share):
        raise DataFailure(
            f"{where}: the depth fits its poses in no unit: {share:.0%} of pixels agree with "
            f"{against(evidence)} within {SAME:.0%}; write it as z in the poses' unit times 1000, "
            "or leave it out with ingest.depth=off"
        )
    fields["depth"] = unit.depth(fields["depth"]).astype(np.float32)
    how = f"1 / ({unit.slope:.5g} d + {unit.shift:.5g})" if unit.inverse else f"{unit.slope:.5g} d"
    notes.append(
        f"Depth d was in another unit than the poses and is taken as {how}: {share:.0%} of pixels "
        f"agree with {against(evidence)} within {SAME:.0%}, {as_it_is:.0%} before."
    )


def codes(fields: dict[str, Any]) -> list[tuple[float, float]]:
    """Replace codes for unknown in depth by nan; each code, and its share of the pixels.

    Choices: a code is a single value of many pixels, far from the range of all others.
    """
    depth = fields["depth"]
    some = depth[:, ::2, ::2]
    values, counts = np.unique(some[some > 0], return_counts=True)
    often = counts >= FREQUENT * some.size
    if not often.any() or often.all():
        return []
    rest = np.repeat(values[~often], counts[~often])
    low, high = np.quantile(rest, (FREQUENT, 1 - FREQUENT))
    outlying = values[often & ((values > FAR * high) | (values < low / FAR))]
    shares = [float((depth == value).mean()) for value in outlying]
    if len(outlying):
        depth[np.isin(depth, outlying)] = np.nan
    return list(zip(outlying.tolist(), shares, strict=True))


def evidence_of(fields: dict[str, Any], references: dict[str, Any]) -> Evidence:
    """Evidence for the depth: points, where there are enough, otherwise the views themselves."""
    if references.get("points") is not None:
        tracks = references.get("tracks")
        at = AtPoints(
            fields, references["points"], np.zeros((0, 2), int) if tracks is None else tracks
        )
        if len(at.stored) >= LEAST:
            return at
    return BetweenViews(fields)


def against(evidence: Evidence) -> str:
    """Name of the evidence in a note."""
    return "the source's points" if isinstance(evidence, AtPoints) else "what other views see"


def agreeing(evidence: Evidence, unit: Unit, within: float = SAME) -> float:
    """Share of the comparable pixels that agree within a bound; 0 where too few can be compared."""
    misses = evidence.misses(unit)
    return float((misses < within).mean()) if len(misses) > COMPARED * len(evidence.stored) else 0.0


def scales(evidence: Evidence) -> list[Unit]:
    """Candidate scales in steps of 3 %, over the evidence's range of depth."""
    low, high = np.log(evidence.between)
    return [Unit(float(np.exp(z) / np.median(evidence.stored))) for z in np.arange(low, high, 0.03)]


def inverses(evidence: Evidence) -> list[Unit]:
    """Candidate units of inverse depth: near ends over the range of depth in steps of 15 %, far
    ends e^0.4 to e^5 times as far; none where the stored depth does not vary.
    """
    near, far = np.quantile(evidence.stored, (0.95, 0.05))
    if near == far:
        return []
    low, high = np.log(evidence.between)
    units = []
    for end, ratio in itertools.product(np.arange(low, high, 0.15), np.arange(LEAST_RATIO, 5, 0.4)):
        slope = (np.exp(-end) - np.exp(-end - ratio)) / (near - far)
        units.append(Unit(float(slope), float(np.exp(-end) - slope * near), True))
    return units


def refined(evidence: Evidence, unit: Unit) -> Unit:
    """Refinement of a unit to the least mean error, clipped at SAME and then at a third of it."""
    near, far = np.quantile(evidence.stored, (0.95, 0.05))

    def changed(x: np.ndarray) -> Unit:
        """The unit whose near and far end are multiplied by exp(x)."""
        if not unit.inverse:
            return Unit(float(unit.slope * np.exp(x[0])))
        ends = (unit.slope * np.array([near, far]) + unit.shift) * np.exp(-x)
        ends[1] = min(ends[1], ends[0] * np.exp(-LEAST_RATIO))
        slope = (ends[0] - ends[1]) / (near - far)
        return Unit(float(slope), float(ends[0] - slope * near), True)

    def miss(x: np.ndarray, most: float) -> float:
        misses = evidence.misses(changed(x))
        return float(np.nan_to_num(misses, nan=most).clip(0, most).mean()) if len(misses) else most

    x = np.zeros(1 + unit.inverse)
    for most in (SAME, SAME / 3):
        simplex = x + 0.03 * np.eye(len(x) + 1, len(x))
        x = minimize(miss, x, most, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    return changed(x)
