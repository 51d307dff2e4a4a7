"""Mean of the teacher's unit features at points of a surface, over the views that see a point."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

NEAREST = 0.05  # metres before a camera
# metres, and share of the depth: how far a point may lie from what a view sees
SEEN_WITHIN = (0.03, 0.01)
SWEPT_WITHIN = (0.08, 0.02)  # the same of points of swept depth, which is off by more


def averaged(
    means: np.ndarray,
    depth: Iterable[np.ndarray],
    features: Iterable[np.ndarray],
    n_channels: int,
    Ks: np.ndarray,
    poses: np.ndarray,
    within: tuple[float, float] = SEEN_WITHIN,
    unit: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the unit features of the views that see a point, and how many these are.

    Returns: f64 [N, d], zero where no view sees a point; i64 [N].

    Args:
      means:    [N, 3] scene units; unit: scene units in a metre.
      depth:    of each view, [H, W] scene units; nan or 0: unknown, where a view sees nothing.
      features: of each view, [h, w, n_channels = d]; a row of zeros does not count. Read view by
        view.
      Ks:       [V, 3, 3] pixels of the depth; poses [V, 4, 4] camera from world.
      within:   metres, and share of the depth, by which a point may lie off what a view sees.
    """
    total, n_views = np.zeros((len(means), n_channels), np.float32), np.zeros(len(means), np.int64)
    for z_of, grid, K, pose in zip(depth, features, Ks, poses, strict=True):
        (height, width), (rows, columns) = z_of.shape, grid.shape[:2]
        camera = means @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(camera[:, 2], 1e-6 * unit)
        u, v = ((camera / z[:, None]) @ K.T)[:, :2].T
        inside = (camera[:, 2] > NEAREST * unit) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = np.flatnonzero(inside)
        hit = z_of[v[index].astype(int), u[index].astype(int)]
        near = np.abs(hit - z[index]) < within[0] * unit + within[1] * z[index]
        index = index[(hit > 0) & near]
        values = grid[
            (v[index] * rows / height).astype(int), (u[index] * columns / width).astype(int)
        ].astype(np.float32)
        lengths = np.linalg.norm(values, axis=1)
        index, values = index[lengths > 0], values[lengths > 0] / lengths[lengths > 0, None]
        total[index] += values
        n_views[index] += 1
    return total / np.maximum(n_views, 1)[:, None], n_views
