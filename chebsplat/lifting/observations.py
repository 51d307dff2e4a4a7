"""What the views say of each Gaussian, and what is made of it without looking at a view again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from chebsplat.lifting import kernels
from chebsplat.rasterize.lift import Lifted

N_BLOCKS = 8  # of views in order, taken in turn by the halves
NEAREST = 0.1  # a chord of directions, below which a view weighs no more for being nearer to the median


@dataclass
class Observations:
    """R observations, one of a Gaussian by a view, those of a Gaussian together, in order of views (CSR).

    starts:  i64 [N + 1], rows of each Gaussian.
    views:   i32 [R], number of the view among those that were gathered.
    weights: f32 [R] > 0, pixels: what the Gaussian makes up of the view, counted as its cells count.
    means:   f32 [R, C], the mean of what these cells say.
    """

    starts: np.ndarray
    views: np.ndarray
    weights: np.ndarray
    means: np.ndarray


@dataclass
class Estimate:
    """Features f32 [N, C], zero where no view sees a Gaussian, and the evidence for them.

    weights:    f32 [N], pixels, over all views.
    n_views:    i32 [N] views that give a Gaussian at least the weight asked for.
    agreement:  f32 [N], r = |Σ w b / |b|| / Σ w: 1 if all views say the same, 0 without a view.
    halves:     f32 [2, N, C], features by each half of the views alone; half_views i32 [2, N], as n_views.
    """

    features: np.ndarray
    weights: np.ndarray
    n_views: np.ndarray
    agreement: np.ndarray
    halves: np.ndarray
    half_views: np.ndarray


def gathered(n: int, n_channels: int, views: Iterable[Lifted]) -> Observations:
    """Sort what views say by Gaussian. Choices: float32, about 4 C bytes an observation; nothing is rendered twice."""
    lifted = list(views)
    counts = np.zeros(n, np.int64)
    for view in lifted:
        counts[view.ids] += 1
    starts = np.concatenate([[0], counts.cumsum()])
    size, cursors = int(starts[-1]), starts[:-1].copy()
    found = Observations(
        starts, np.empty(size, np.int32), np.empty(size, np.float32), np.empty((size, n_channels), np.float32)
    )
    for number, view in enumerate(lifted):
        kernels.place(*view, number, cursors, found.views, found.weights, found.means)
    return found


def estimate(observations: Observations, median_steps: int = 0, min_weight: float = 0.0) -> Estimate:
    """Features of every Gaussian and the evidence for them.

    Args:
      median_steps: of Weiszfeld's, from the weighted mean towards the geometric median of the views' directions
                    b / |b|; 0: the mean.
      min_weight:   pixels; a view of less is not counted in n_views.
    Choices: the result is Σ f b / Σ f with f > 0, so that it never leaves the cone of what views said, as the exact
      least-squares solution does. Chords below NEAREST count as NEAREST: no single view takes all.
    """
    starts, seen = observations.starts, observations.weights >= min_weight
    half_of = halves_of(int(observations.views.max(initial=-1)) + 1)
    features, agreement = kernels.averages(*vars(observations).values(), half_of, median_steps, NEAREST)
    owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    n = len(starts) - 1
    half_views = np.stack(
        [np.bincount(owner[seen & (half_of[observations.views] == half)], minlength=n) for half in (0, 1)]
    ).astype(np.int32)
    weights = np.bincount(owner, observations.weights, minlength=n).astype(np.float32)
    return Estimate(features[0], weights, half_views.sum(0, dtype=np.int32), agreement, features[1:], half_views)


def halves_of(n_views: int) -> np.ndarray:
    """Which half each view is of, i8 [V].

    Choices: N_BLOCKS blocks of successive views, by turns: neighbours on a path see alike and err alike, so that halves
      of every other view would agree on what is wrong.
    """
    return (np.arange(n_views) // max(n_views // N_BLOCKS, 1) % 2).astype(np.int8)
