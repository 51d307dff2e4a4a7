"""What hangs together: Gaussians that reach one another through Gaussians of their kind."""

from __future__ import annotations

import numpy as np

NEIGHBORS = 16  # nearest of the kind that a Gaussian is held against
REACH = 2.0  # standard deviations along the longest axis


def connected_to(seed: int, means: np.ndarray, scales: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Which of the Gaussians in `among` are connected to one of them.

    Args:
      seed:   row of a Gaussian of `among`.
      means:  [N, 3] centres; scales: [N, 3] standard deviations, activated; both scene units.
      among:  bool [N], as of one label.
    Returns: bool [N], true at `seed`.
    Raises:  ValueError if `seed` is not among them.
    Choices: two touch if the spheres of two standard deviations along their longest axes do; each is held against its
      16 nearest, which is symmetrised by union.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not among[seed]:
        raise ValueError(f"Gaussian {seed} is not among those to connect")
    rows = np.flatnonzero(among)
    n, reach = len(rows), REACH * scales[rows].max(1)
    if n == 1:
        return among.copy()
    distances, near = cKDTree(means[rows]).query(means[rows], k=min(NEIGHBORS + 1, n))
    touching = distances <= reach[:, None] + reach[near]
    starts = np.broadcast_to(np.arange(n)[:, None], near.shape)[touching]
    edges = coo_array((np.ones(len(starts), bool), (starts, near[touching])), shape=(n, n))
    _, parts = connected_components(edges, directed=False)
    found = np.zeros(len(among), bool)
    found[rows] = parts == parts[np.searchsorted(rows, seed)]
    return found
