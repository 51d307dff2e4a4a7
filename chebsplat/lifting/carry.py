"""From points to the Gaussians beside them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

N_POINTS = 3
NEAR = 0.01  # metres, within which a point is no nearer than another
LEAST_COSINE = 0.1  # of the angle between normals, so that a Gaussian of chance orientation still has an answer


def carry(
    values: np.ndarray,
    points: np.ndarray,
    point_normals: np.ndarray,
    means: np.ndarray,
    normals: np.ndarray,
    unit: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """What is known at points, for Gaussians: the mean of the N_POINTS nearest, by distance and normal.

    Args: values [P, C] at points [P, 3], scene units, with point_normals [P, 3]; means [N, 3] with normals [N, 3]; all
          normals unit, of any sign; unit: scene units of a metre, > 0.
    Returns: f32 [N, C], and the distance to the nearest point in scene units, f32 [N], for who trusts near points only.
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
