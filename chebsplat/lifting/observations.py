"""Observations of Gaussians by views, and features made of them without another look at a view.

A teacher's map of a view becomes a value for each cell of 4×4 pixels; what is known at points goes
to Gaussians beside them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.kernels.threads import in_parts
from chebsplat.lifting import kernels
from chebsplat.rasterize.cells import CELL
from chebsplat.rasterize.lift import Lifted

N_BLOCKS = 8  # of views in order, taken in turn by the halves
# a chord of directions, below which a view weighs no more for being nearer to the median
NEAREST = 0.1
N_POINTS = 3
NEAR = 0.01  # metres, within which a point is no nearer than another
# of the angle between normals, so that a Gaussian of chance orientation still has an answer
LEAST_COSINE = 0.1


@dataclass
class Observations:
    """R observations, one of a Gaussian by a view, those of a Gaussian together, in order of views
    (CSR).

    starts:  i64 [N + 1], rows of each Gaussian.
    views:   i32 [R], number of the view among those that were gathered.
    weights: f32 [R] > 0, pixels: what the Gaussian makes up of the view, counted as its cells
      count.
    means:   f32 [R, C], the mean of these cells' values.
    """

    starts: np.ndarray
    views: np.ndarray
    weights: np.ndarray
    means: np.ndarray


@dataclass
class Estimate:
    """Features f32 [N, C], zero where no view sees a Gaussian, and the evidence for them.

    weights:    f32 [N], pixels, over all views.
    n_views:    i32 [N] views that give a Gaussian at least `min_weight`.
    agreement:  f32 [N], r = |Σ w b / |b|| / Σ w: 1 if all views agree, 0 without a view.
    halves:     f32 [2, N, C], features by each half of the views alone; half_views i32 [2, N], as
      n_views.
    """

    features: np.ndarray
    weights: np.ndarray
    n_views: np.ndarray
    agreement: np.ndarray
    halves: np.ndarray
    half_views: np.ndarray


def gathered(n: int, n_channels: int, views: Iterable[Lifted]) -> Observations:
    """Views' observations by Gaussian. Choices: float32, 4 C bytes each; one rendering a view."""
    lifted = list(views)
    counts = np.zeros(n, np.int64)
    for view in lifted:
        counts[view.ids] += 1
    starts = np.concatenate([[0], counts.cumsum()])
    size, cursors = int(starts[-1]), starts[:-1].copy()
    observations = Observations(
        starts,
        np.empty(size, np.int32),
        np.empty(size, np.float32),
        np.empty((size, n_channels), np.float32),
    )
    for number, view in enumerate(lifted):
        in_parts(kernels.place, len(view.ids), *view, number, cursors, observations.views,
                 observations.weights, observations.means)  # fmt: skip
    return observations


def estimate(
    observations: Observations, median_steps: int = 0, min_weight: float = 0.0
) -> Estimate:
    """Features of every Gaussian and the evidence for them.

    Args:
      median_steps: of Weiszfeld's, from the weighted mean towards the geometric median of the
        views' directions b / |b|; 0: the mean.
      min_weight:   pixels; a view of less is not counted in n_views.
    Choices: the result is Σ f b / Σ f with f > 0, so that it never leaves the cone of what views
      said, as the exact least-squares solution does. Chords below NEAREST count as NEAREST: no
      single view takes all.
    """
    starts, enough = observations.starts, observations.weights >= min_weight
    half_of = halves_of(int(observations.views.max(initial=-1)) + 1)
    features, agreement = kernels.averages(
        starts,
        observations.views,
        observations.weights,
        observations.means,
        half_of,
        median_steps,
        NEAREST,
    )
    owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    n = len(starts) - 1
    half_views = np.stack(
        [
            np.bincount(owner[enough & (half_of[observations.views] == half)], minlength=n)
            for half in (0, 1)
        ]
    ).astype(np.int32)
    weights = np.bincount(owner, observations.weights, minlength=n).astype(np.float32)
    return Estimate(
        features[0], weights, half_views.sum(0, dtype=np.int32), agreement, features[1:], half_views
    )


def halves_of(n_views: int) -> np.ndarray:
    """Half, 0 or 1, that each view belongs to, i8 [V].

    Choices: N_BLOCKS blocks of successive views, by turns: neighbours on a path see alike and err
      alike, so that halves of every other view would agree on what is wrong.
    """
    return (np.arange(n_views) // max(n_views // N_BLOCKS, 1) % 2).astype(np.int8)


def carry(
    values: np.ndarray,
    points: np.ndarray,
    point_normals: np.ndarray,
    means: np.ndarray,
    normals: np.ndarray,
    unit: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Values of points carried to Gaussians: mean of the N_POINTS nearest, by distance and normal.

    Args: values [P, C] at points [P, 3], scene units, with point_normals [P, 3]; means [N, 3] with
      normals [N, 3]; all normals unit, of any sign; unit: scene units of a metre, > 0.
    Returns: f32 [N, C], and the distance to the nearest point in scene units, f32 [N], for who
      trusts near points only.
    Raises:  ValueError without points.
    Choices: weights max(|n·n'|, LEAST_COSINE)² / (d² + NEAR²).
    """
    if len(points) == 0:
        raise ValueError("there are no points to carry from")
    k = min(N_POINTS, len(points))
    distances, index = cKDTree(points).query(means, np.arange(1, k + 1), workers=-1)
    facing = np.abs(np.einsum("nkd,nd->nk", point_normals[index], normals)).clip(LEAST_COSINE, 1)
    weights = facing**2 / ((distances / unit) ** 2 + NEAR**2)
    weights /= weights.sum(1, keepdims=True)
    carried = (weights[:, None].astype(np.float32) @ values[index].astype(np.float32))[:, 0]
    return carried, distances[:, 0].astype(np.float32)


def overlaps(n_entries: int, n_pixels: int) -> np.ndarray:
    """Part of each cell that each of n entries, spread evenly over the pixels, covers: [⌈pixels/4⌉,
    n], rows sum to 1.

    A last cell that the image cuts off is its part inside.
    """
    edges = np.minimum(np.arange(-(-n_pixels // CELL) + 1) * CELL, n_pixels)[:, None].astype(
        np.float64
    )
    marks = np.arange(n_entries + 1) * (n_pixels / n_entries)
    covered = np.minimum(edges[1:], marks[1:]) - np.maximum(edges[:-1], marks[:-1])
    return covered.clip(0) / (edges[1:] - edges[:-1])  # type: ignore[no-any-return]


def to_cells(
    features: np.ndarray, counts: np.ndarray, size: tuple[int, int], mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Value of each cell of a view, and its weight.

    Args:
      features: [h, w, C] of the teacher; an entry that is zero in all channels, or not finite,
        does not count.
      counts:   [h, w] >= 0, what an entry counts.
      size:     width and height of the view, pixels; mask [H, W] true where a pixel counts, or
        None.
    Returns: values f32 [⌈H/4⌉, ⌈W/4⌉, C], counts f32 [⌈H/4⌉, ⌈W/4⌉], 0 where nothing counts.
    Choices: a cell is the mean of the entries that it lies in, by the area that each covers of it:
      exact on a grid of cells, an average of a finer one, a copy of a coarser one. A cell counts if
      all its pixels do, as the reduced pixels that a training looks at.
    """
    values = features.astype(np.float32)
    usable = np.isfinite(values).all(-1) & values.any(-1)
    share = np.where(usable, counts, 0).astype(np.float32)
    values[~usable] = 0
    width, height = size
    shape = (-(-height // CELL), -(-width // CELL))
    if share.shape != shape or height % CELL or width % CELL:
        down, across = overlaps(share.shape[0], height), overlaps(share.shape[1], width)
        sums = np.einsum("yh,hwc,xw->yxc", down, values * share[..., None], across, optimize=True)
        share = (down @ share @ across.T).astype(np.float32)
        values = (sums / np.where(share > 0, share, 1)[..., None]).astype(np.float32)
    if mask is not None:
        padded = np.pad(mask, ((0, -height % CELL), (0, -width % CELL)), constant_values=True)
        share = share * padded.reshape(shape[0], CELL, shape[1], CELL).all((1, 3))
    return values, share
