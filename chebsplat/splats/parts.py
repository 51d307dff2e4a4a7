"""What hangs together: Gaussians that touch, and those that touch them, are one part."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

NEIGHBORS = 16  # nearest of the chosen that a Gaussian is held against
REACH = 2.0  # standard deviations along the longest axis


def parts(means: np.ndarray, scales: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Number of the part of each chosen Gaussian, i64 [N], the largest part 0; -1 for all others.

    Args: means [N, 3]; scales [N, 3] standard deviations, activated; both scene units; chosen: bool [N].
    Choices: two touch if the spheres of two standard deviations along their longest axes do; each is held against its
      16 nearest, which is symmetrised by union. Parts of one size are in order of their first Gaussians.
    """
    found, rows = np.full(len(chosen), -1, np.int64), np.flatnonzero(chosen)
    n = len(rows)
    if n < 2:
        found[rows] = 0
        return found
    reach = REACH * scales[rows].max(1)
    distances, near = cKDTree(means[rows]).query(means[rows], k=min(NEIGHBORS + 1, n))
    touching = distances <= reach[:, None] + reach[near]
    starts = np.broadcast_to(np.arange(n)[:, None], near.shape)[touching]
    edges = coo_array((np.ones(len(starts), bool), (starts, near[touching])), shape=(n, n))
    _, numbers = connected_components(edges, directed=False)
    order = np.argsort(-np.bincount(numbers), kind="stable")
    found[rows] = np.argsort(order)[numbers]
    return found


def substantial(means: np.ndarray, scales: np.ndarray, chosen: np.ndarray, least: float = 0.1) -> np.ndarray:
    """The chosen without their crumbs: bool [N], those of parts of at least a share `least` of the largest part."""
    numbers = parts(means, scales, chosen)
    sizes = np.bincount(numbers[chosen])
    kept: np.ndarray = chosen.copy()
    if len(sizes):
        kept[chosen] = sizes[numbers[chosen]] >= least * sizes[0]
    return kept
