"""Pinhole cameras: centres, scene extent, back-projection, and the change of resolution."""

from __future__ import annotations

import numpy as np


def centers(cam_from_world: np.ndarray) -> np.ndarray:
    """Camera centres [V, 3] in the world, of poses [V, 4, 4]."""
    rotations, translations = cam_from_world[:, :3, :3], cam_from_world[:, :3, 3]
    eyes: np.ndarray = -np.einsum("vji,vj->vi", rotations, translations)
    return eyes


def extent(cam_from_world: np.ndarray) -> float:
    """1.1 times the largest distance of a camera from their mean, scene units, as in 3DGS."""
    where = centers(cam_from_world)
    return float(1.1 * np.linalg.norm(where - where.mean(0), axis=1).max(initial=0.0)) or 1.0


def resized(K: np.ndarray, factor_x: float, factor_y: float) -> np.ndarray:
    """Intrinsics [..., 3, 3] of a resized image: with half-integer pixel centres entries scale."""
    scaled: np.ndarray = K * np.array([[factor_x], [factor_y], [1.0]])
    return scaled


def unproject(
    depth: np.ndarray, K: np.ndarray, cam_from_world: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """World points of pixels with depth.

    Args:
      depth:  [H, W] z-depth, scene units; K [3, 3] pixels; cam_from_world [4, 4].
      pixels: [P, 2] int (row, column).
    Returns: [P, 3] float64.
    """
    z = depth[pixels[:, 0], pixels[:, 1]].astype(np.float64)
    image = np.stack([pixels[:, 1] + 0.5, pixels[:, 0] + 0.5, np.ones(len(pixels))], 1)
    rays = image @ np.linalg.inv(K).T
    camera = rays * z[:, None]
    world: np.ndarray = (camera - cam_from_world[:3, 3]) @ cam_from_world[:3, :3]
    return world


def common_up(cam_from_world: np.ndarray) -> tuple[np.ndarray, float]:
    """The direction [3] against gravity that cameras [V, 4, 4] held upright share, and how sure
    that is, in [0, 1].

    Choices: the direction that the cameras' horizontal axes span least; its sign from where their
      tops point. The confidence is 1 less the ratio of the two least spreads of these axes: 0 where
      all cameras look the same way, whose pitch is undetermined, or where they are rolled at
      random; times the mean cosine of their tops with it.
    """
    rights, tops = cam_from_world[:, 0, :3], -cam_from_world[:, 1, :3]
    spreads, axes = np.linalg.eigh(rights.T @ rights)
    up = axes[:, 0] * (1.0 if (tops @ axes[:, 0]).sum() >= 0 else -1.0)
    certainty = 1.0 - spreads[0] / spreads[1] if spreads[1] > 1e-6 * spreads[2] else 0.0
    return up, float(np.clip(certainty * (tops @ up).mean(), 0.0, 1.0))


def upright(up: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] that turns `up` into z. Raises ValueError where it has no length."""
    length = float(np.linalg.norm(up))
    if not length > 0:
        raise ValueError("up has no length")
    z = np.asarray(up, np.float64) / length
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
