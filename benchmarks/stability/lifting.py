"""Views and votes that break plain averages of views by Gaussian (docs/method.md, section 12)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.stability.case import Outcome, beside, case, relative
from benchmarks.stability.splats import HEIGHT, WIDTH, K, gaussians
from chebsplat.lifting.observations import NEAREST, Observations, estimate, to_cells
from chebsplat.rasterize import lift, reference

CELLS, CHANNELS, STEPS = (HEIGHT // 4, WIDTH // 4), 5, 5
VIEW = 1e-4  # float32 weights of what makes up a hundredth of a view, and more
VOTES = 1e-5  # float32 results of vectors that cancel to a tenth


class CellMap(NamedTuple):
    """Values and counts of a view's cells, and the unit and the shift of its Gaussians."""

    values: np.ndarray
    counts: np.ndarray
    unit: float = 1.0
    shift: float = 0.0


def cell_map(
    size: float = 1.0, counts: Any = 1.0, hole: float | None = None, **place: float
) -> CellMap:
    """Noise; hole: value of a third of the cells, which count nothing."""
    values = (size * np.random.default_rng(0).normal(size=(*CELLS, CHANNELS))).astype(np.float32)
    cells = CellMap(values, np.broadcast_to(counts, CELLS).astype(np.float32), **place)
    if hole is not None:
        cells.counts[::3], cells.values[::3] = 0, hole
    return cells


VIEWS: dict[str, Callable[[], CellMap]] = {
    "values of 1e-30": lambda: cell_map(1e-30),
    "values of 1e+30": lambda: cell_map(1e30),
    "counts of 1e-30": lambda: cell_map(counts=1e-30),
    "counts of 1e+30": lambda: cell_map(counts=1e30),
    "values of 1e-20, counts of 1e-20": lambda: cell_map(1e-20, 1e-20),
    "counts of 1e-15 to 1e+15": lambda: cell_map(
        counts=np.geomspace(1e-15, 1e15, 70).reshape(CELLS)
    ),
    "nothing counts": lambda: cell_map(counts=0.0),
    "NaN where nothing counts": lambda: cell_map(hole=np.nan),
    "inf where nothing counts": lambda: cell_map(hole=np.inf),
    "one cell counts": lambda: cell_map(counts=np.eye(1, 70, 34).reshape(CELLS)),
    "units of 1e+03": lambda: cell_map(unit=1e3),
    "1e+04 from the origin": lambda: cell_map(shift=1e4),
}


@case("a view, {name}", name=VIEWS)
def of_a_view(name: str) -> Outcome:
    """Mean value of each Gaussian against float64 at every pixel; plainly, all cells are alike."""
    values, counts, unit, shift = VIEWS[name]()
    means, quats, scales, opacities, _ = (part.numpy() for part in gaussians().values())
    pose = np.eye(4)
    pose[:3, 3] = -shift
    parts = (
        (unit * means + shift).astype(np.float32),
        quats,
        (unit * scales).astype(np.float32),
        opacities,
    )
    camera = pose, K.double().numpy(), (WIDTH, HEIGHT)
    lifted = lift.lift(parts, *camera, values, counts)
    ours, (weights, sums) = (
        np.zeros((len(means), CHANNELS + 1)),
        reference.lift(parts, *camera, values, counts),
    )
    ours[lifted.ids] = np.column_stack([lifted.weights, lifted.sums])
    heard = weights > 1e-2 * weights.max()

    def plainly() -> np.ndarray:
        by_cell = (
            reference.pixel_weights(parts, *camera)
            .reshape(CELLS[0], 4, CELLS[1], 4, -1)
            .sum((1, 3))
        )
        w = by_cell[..., heard].astype(np.float32) * counts[..., None]
        return np.einsum("yxn,yxc->nc", w, values) / w.sum((0, 1))[:, None]

    return beside(
        (ours[:, 1:] / np.maximum(ours[:, :1], 1e-38))[heard],
        plainly,
        (sums / np.maximum(weights, 1e-300)[:, None])[heard],
        VIEW,
    )


SPOILED_MAPS: dict[str, Callable[[np.ndarray, np.ndarray], object]] = {
    "as it is": lambda values, counts: None,
    "half NaN": lambda values, counts: values[::2, 1:].fill(np.nan),
    "half infinite, half counts nothing": lambda values, counts: (
        values[::2].fill(np.inf),
        counts[1::2].fill(0),
    ),
    "half zero, counts of 1e-30": lambda values, counts: (
        values[:, ::2].fill(0),
        counts.__imul__(1e-30),
    ),
    "values and counts of 1e+15": lambda values, counts: (
        values.__imul__(1e15),
        counts.__imul__(1e15),
    ),
}


@case(
    "cells of a map of {size}, {name}", size=[(1, 1), (5, 3), (7, 10), (28, 40)], name=SPOILED_MAPS
)
def cells(size: tuple[int, int], name: str) -> Outcome:
    """Means by area of finite, non-zero entries, and their counts, each over its largest, against
    pieces that entries and cells both consist of; the plain way takes the entry at a cell's middle.
    """
    rng = np.random.default_rng(3)
    values, counts = (
        rng.normal(size=(*size, CHANNELS)).astype(np.float32),
        rng.uniform(1, 2, size).astype(np.float32),
    )
    SPOILED_MAPS[name](values, counts)
    usable = np.isfinite(values).all(-1) & values.any(-1)
    rows, columns = (
        np.arange(np.lcm(pixels, n)) * n // np.lcm(pixels, n)
        for pixels, n in zip((HEIGHT, WIDTH), size, strict=True)
    )
    weights = np.where(usable, counts, 0).astype(np.float64)[np.ix_(rows, columns)]
    pieces = np.where(usable[..., None], values, 0).astype(np.float64)[np.ix_(rows, columns)]
    shape = CELLS[0], len(rows) // CELLS[0], CELLS[1], len(columns) // CELLS[1]
    share = weights.reshape(shape).mean((1, 3))
    sums = (pieces * weights[..., None]).reshape(*shape, CHANNELS).mean((1, 3))
    exact = sums / np.where(share > 0, share, 1)[..., None], share

    def plainly() -> tuple[np.ndarray, np.ndarray]:
        index = np.ix_(
            *((np.arange(n) * 2 + 1) * m // (2 * n) for n, m in zip(CELLS, size, strict=True))
        )
        return values[index], counts[index]

    def apart(ours: tuple[np.ndarray, ...], exact: tuple[np.ndarray, ...]) -> float:
        there = exact[1] > 0
        return max(relative(ours[0][there], exact[0][there]), relative(ours[1], exact[1]))

    return beside(to_cells(values, counts, (WIDTH, HEIGHT)), plainly, exact, VOTES, apart)


class Votes(NamedTuple):
    """Of G Gaussians by V views each: weights [G, V], means [G, V, C]."""

    weights: np.ndarray
    means: np.ndarray


def votes(n_views: int = 7, size: Any = 1.0, weight: Any = 1.0) -> Votes:
    rng = np.random.default_rng(1)
    weights, means = (
        rng.uniform(0.5, 2, (12, n_views)),
        rng.normal(size=(12, n_views, CHANNELS)) + 1,
    )
    return Votes(
        (weight * weights).astype(np.float32),
        (np.asarray(size)[..., None] * means).astype(np.float32),
    )


def one_against(n_views: int = 7) -> Votes:
    """One view says the opposite of all others, which say the same."""
    same = votes(n_views)
    means = np.repeat(same.means[:, :1], n_views, 1)
    means[:, 3] *= -1
    return same._replace(means=means)


ESTIMATES: dict[str, Callable[[], Votes]] = {
    "one view": lambda: votes(1),
    "views that say the same": lambda: Votes(
        votes().weights, np.repeat(votes().means[:, :1], 7, 1)
    ),
    "one view against six": one_against,
    "2000 views": lambda: votes(2000),
    "votes of 1e-20": lambda: votes(size=1e-20),
    "votes of 1e+30": lambda: votes(size=1e30),
    "votes of 1e-15 to 1e+15": lambda: votes(size=np.geomspace(1e-15, 1e15, 7)),
    "weights of 1e-30": lambda: votes(weight=1e-30),
    "weights of 1e+30": lambda: votes(weight=1e30),
    "weights of 1e-30 to 1e+30": lambda: votes(weight=np.geomspace(1e-30, 1e30, 7)),
    "a view says nothing": lambda: votes(size=np.arange(7) != 3),
}


def median(of: Votes, dtype: type, floor: float) -> np.ndarray:
    """STEPS of Weiszfeld's from the weighted mean of directions, then the weighted mean, [G, C]."""
    w, b = (part.astype(dtype) for part in of)
    lengths = np.sqrt((b * b).sum(-1))
    directions = b / (np.maximum(lengths, 1e-12) if floor else lengths)[..., None]
    factors = w
    for _ in range(STEPS):
        toward = (factors[..., None] * directions).sum(1)
        cosines = (
            np.einsum("gvc,gc->gv", directions, toward)
            / np.sqrt((toward * toward).sum(-1))[:, None]
        )
        factors = w / np.maximum(np.sqrt(np.maximum(2 - 2 * cosines, 0)), floor)
    return np.asarray((factors[..., None] * b).sum(1) / factors.sum(1)[:, None])


@case("an estimate, {name}", name=ESTIMATES)
def estimates(name: str) -> Outcome:
    """Features against 80 bits; the plain way bounds no view and divides by every length."""
    of = ESTIMATES[name]()
    n, n_views = of.weights.shape
    rows = np.tile(np.arange(n_views, dtype=np.int32), n)
    observations = Observations(
        np.arange(n + 1) * n_views, rows, of.weights.ravel(), of.means.reshape(-1, CHANNELS)
    )
    exact = median(of, np.longdouble, NEAREST)
    return beside(
        estimate(observations, STEPS).features, lambda: median(of, np.float32, 0.0), exact, VOTES
    )
