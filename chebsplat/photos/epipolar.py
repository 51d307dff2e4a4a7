"""How far matched features miss each other's epipolar lines: what poses are worth, without any point of the scene."""

from __future__ import annotations

import numpy as np


def fundamental(K: np.ndarray, pose: np.ndarray, K_other: np.ndarray, pose_other: np.ndarray) -> np.ndarray:
    """F [3, 3] of two views with intrinsics [3, 3] and cam_from_world [4, 4]: x'ᵀ F x = 0 for pixels of one point."""
    between = pose_other @ np.linalg.inv(pose)
    x, y, z = between[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:3, :3]
    return np.asarray(np.linalg.inv(K_other).T @ essential @ np.linalg.inv(K))


def sampson_distance(F: np.ndarray, pixels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Pixels by which matches miss, to first order: |x'ᵀ F x| / √(‖(F x)₁₂‖² + ‖(Fᵀ x')₁₂‖²).

    Args:    F: [3, 3]; pixels, others: [N, 2] in the first and the second view.
    Returns: [N]; nan where F is zero, as for two views from one place.
    """
    x, y = (np.column_stack([at, np.ones(len(at))]) for at in (pixels, others))
    lines, back = x @ F.T, y @ F
    size = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs((y * lines).sum(1)) / size)
