"""Bilateral smoothing of features over Gaussians that look alike and lie in one plane; nothing is
learned.

Lengths are in metres times `unit`, the scene units of a metre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

N_NEIGHBORS = 24
REACH = 0.3  # metres, of neighbours
# metres: standard deviations of the distance, and of that from the own plane
DISTANCE, PLANE = 0.15, 0.03
# the same of a colour's difference, of [0, 1] a channel, and of the normals' angle, rad
COLOR, ANGLE = 0.1, 0.5
PASSES = 3  # of smoothing: a fourth gains little, and later ones carry labels over edges
HALF_EXTENT = 2.7  # metres from the middle that half of a furnished room's Gaussians lie within
# Gaussians, evenly of all, whose distance to the 8th nearest separates the room from what lies far
# behind it: there it is more than APART times what it is for the quarter that lies closest.
SAMPLED, NTH, APART = 20_000, 8, 10.0
ROWS = 4096  # Gaussians that are worked off at once


class Affinities(NamedTuple):
    """neighbors i32 [N, K] of each Gaussian, without it; weights f32 [N, K] in [0, 1], 0: none."""

    neighbors: np.ndarray
    weights: np.ndarray


def room_unit(means: np.ndarray) -> float:
    """Scene units of a metre if Gaussians at [N, 3] fill a room; for scenes of unknown scale.

    Choices: the median distance from the middle is taken for HALF_EXTENT, of those that lie as
      close together as a room is filled: a background far away does not count, be it most of them.
      1 where all Gaussians coincide. In generated rooms of 3.4 to 7 m it lies between 0.8 and 1.3.
    """
    some = means[:: max(-(-len(means) // SAMPLED), 1)]
    spacing = (
        cKDTree(some).query(some, [min(NTH + 1, len(some))])[0][:, 0] if len(some) else np.zeros(0)
    )
    if not spacing.any():
        return 1.0
    some = some[spacing <= APART * np.quantile(spacing[spacing > 0], 0.25)]
    return (
        float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1))) / HALF_EXTENT
        or 1.0
    )


def affinities(
    means: np.ndarray, normals: np.ndarray, colors: np.ndarray, unit: float = 1.0
) -> Affinities:
    """Nearest neighbours of each Gaussian, weighted by likeness.

    Args: means [N, 3] scene units; normals [N, 3] unit, of any sign; colors [N, 3] in [0, 1]; unit
      > 0.
    Returns: the N_NEIGHBORS nearest within REACH. The weight of one at offset x, with colour
      difference c and an angle θ between its normal and the own n, is

          exp(-|x|² / 2 DISTANCE² - |c|² / 2 COLOR² - θ² / 2 ANGLE² - (n·x)² / 2 PLANE²)

    Raises: ValueError on a unit that is not positive, or arrays that do not fit.
    Choices: one-sided, the own normal decides where the plane is; a Gaussian as thick as it is wide
      has a normal by chance, and so a few neighbours.
    """
    n = len(means)
    if (
        not unit > 0
        or not np.isfinite(unit)
        or any(a.shape != (n, 3) for a in (means, normals, colors))
    ):
        raise ValueError(
            "a positive unit and means, normals and colours of one shape [N, 3] are needed"
        )
    index = np.zeros((n, min(N_NEIGHBORS, max(n - 1, 0))), np.int32)
    weights = np.zeros(index.shape, np.float32)
    if index.size == 0:
        return Affinities(index, weights)
    where = (means.astype(np.float64) - means.mean(0)) / unit
    _, neighbors = cKDTree(where).query(
        where, index.shape[1] + 1, distance_upper_bound=REACH, workers=-1
    )
    for start in range(0, n, ROWS):
        rows = np.arange(start, min(start + ROWS, n))
        nearest = _without_self(neighbors[rows], rows)
        there = nearest < n
        nearest = np.where(there, nearest, rows[:, None])
        offsets = where[nearest] - where[rows, None]
        across = np.einsum("nkd,nd->nk", offsets, normals[rows])
        cosines = np.abs(np.einsum("nkd,nd->nk", normals[nearest], normals[rows])).clip(0, 1)
        exponent = (
            (offsets**2).sum(-1) / DISTANCE**2
            + (across / PLANE) ** 2
            + ((colors[nearest] - colors[rows, None]) ** 2).sum(-1) / COLOR**2
            + (np.arccos(cosines) / ANGLE) ** 2
        )
        index[rows], weights[rows] = nearest, np.where(there, np.exp(-0.5 * exponent), 0)
    return Affinities(index, weights)


def _without_self(neighbors: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Neighbours [n, K] of [n, K + 1], less each row's own number, or the farthest without it."""
    own = neighbors == rows[:, None]
    own[:, -1] |= ~own.any(1)
    others: np.ndarray = neighbors[~own].reshape(len(neighbors), -1)
    return others


def smooth(
    features: np.ndarray, evidence: np.ndarray, near: Affinities, passes: int = PASSES
) -> np.ndarray:
    """Features of each Gaussian and its neighbours, averaged by affinity and evidence as many times
    as there are passes, f32 [N, C].

        f̃_i = (e_i f_i + Σ_j w_ij e_j f_j) / (e_i + Σ_j w_ij e_j)

    Args: features [N, C]; evidence [N] >= 0, such as the number of views; near: of the same
      Gaussians.
    Choices: where neither a Gaussian nor a neighbour has evidence the features stay what they are.
    """
    evidence, smoothed = evidence.astype(np.float32), features.astype(np.float32)
    for _ in range(passes):
        weighted = smoothed * evidence[:, None]
        for start in range(0, len(features), ROWS):
            rows = slice(start, start + ROWS)
            index, weights = near.neighbors[rows], near.weights[rows]
            total = evidence[rows] + (weights * evidence[index]).sum(1)
            sums = weighted[rows] + (weights[:, None] @ weighted[index])[:, 0]
            some = total > 0
            smoothed[rows][some] = sums[some] / total[some, None]
    return smoothed
