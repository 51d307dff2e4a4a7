"""What a scene means at points of space, apart from any view: features of its Gaussians where true surfaces are."""

from __future__ import annotations

import numpy as np

from chebsplat.splats.cubes import first_of_each

REACH = 3.0  # standard deviations
CELLS = 128  # along the longest side of what is measured
CHUNK = 2048  # Gaussians at a time, so that their pairs with points stay in memory


def features_at(
    points: np.ndarray,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the features of all Gaussians at each point, weighted by opacity times density relative to its peak.

    Args:
      points:    [M, 3] scene units.
      means:     [N, 3]; quats [N, 4] wxyz of any length; scales [N, 3] standard deviations; opacities [N] in (0, 1).
      features:  [N, C].
    Returns: features f32 [M, C], zero where no Gaussian reaches; weights f32 [M], their sums.
    Choices: a Gaussian ends at 3 standard deviations. Nothing occludes anything: what lies in front of a point or
      behind it by more than that has no say.
    """
    from scipy.sparse import coo_matrix
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    sums, weights = np.zeros((len(points), features.shape[1])), np.zeros(len(points))
    if not len(points) or not len(means):
        return sums.astype(np.float32), weights.astype(np.float32)
    tree = cKDTree(points)
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    for start in range(0, len(means), CHUNK):
        rows = slice(start, start + CHUNK)
        near = tree.query_ball_point(means[rows], REACH * scales[rows].max(1))
        row = np.repeat(np.arange(len(near)), [len(indices) for indices in near])
        point = np.fromiter((k for indices in near for k in indices), np.int64, len(row))
        gaussian = row + start
        local = np.einsum("pi,pij->pj", points[point] - means[gaussian], axes[gaussian]) / scales[gaussian]
        squared = (local**2).sum(1)
        weight = np.where(squared <= REACH**2, opacities[gaussian] * np.exp(-0.5 * squared), 0.0)
        matrix = coo_matrix((weight, (point, row)), (len(points), len(near))).tocsr()
        sums += matrix @ features[rows]
        weights += np.asarray(matrix.sum(1))[:, 0]
    reached = np.maximum(weights, 1e-12)[:, None]
    return (sums / reached).astype(np.float32), weights.astype(np.float32)


def thinned(points: np.ndarray) -> np.ndarray:
    """Which of points [M, 3] are kept: the first of each cell, so that an area counts as often as it is large.

    Choices: 128 cells along the longest side of the box that holds 98 % of the points along each axis; a stray depth
      beyond it does not coarsen them.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    side = float((high - low).max()) / CELLS or 1.0
    return first_of_each(points, side, low)
