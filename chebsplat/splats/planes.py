"""Gaussians as planes: each through its centre, across its shortest axis."""

from __future__ import annotations

import numpy as np

GRAZING = 0.15  # cosine of the view's angle to a plane below which its depth is that of the centre


def inverse_depths(means: np.ndarray, normals: np.ndarray, K: np.ndarray, nearest: float) -> np.ndarray:
    """q [N, 3] of each Gaussian's plane, in a camera's frame: 1 / z = q · (u, v, 1) at pixel (u, v).

    Choices: a plane that is seen at a grazing angle is taken to face the camera; its depth would be without bound.
    """
    along = np.einsum("nk,nk->n", normals, means)
    grazing = np.abs(along) < GRAZING * np.linalg.norm(means, axis=1).clip(nearest)
    planes: np.ndarray = normals @ np.linalg.inv(K) / np.where(grazing, 1.0, along)[:, None]
    planes[grazing] = 0
    planes[grazing, 2] = 1 / means[grazing, 2].clip(nearest)
    return planes
