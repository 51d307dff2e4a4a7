"""Labels of points by the volumes that hold them: upright prisms over convex polygons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull


class Volume(NamedTuple):
    """faces f64 [F, 4]: a point x lies faces[:, :3] @ x + faces[:, 3] outside of each; low, high
    [3]: corners of the box about it.
    """

    faces: np.ndarray
    low: np.ndarray
    high: np.ndarray


def prism(corners: np.ndarray, bottom: float, top: float) -> Volume:
    """The prism from height `bottom` to `top` over a polygon of corners [N, 2] in any order.

    Raises: ValueError where polygon and heights hold no volume, or a corner lies among the others.
    """
    solid = np.vstack([np.column_stack([corners, np.full(len(corners), z)]) for z in (bottom, top)])
    if (
        not bottom < top
        or len(corners) < 3
        or np.linalg.matrix_rank(corners - corners[0], 1e-9) < 2
    ):
        raise ValueError("holds no volume")
    hull = ConvexHull(solid)
    if len(hull.vertices) < len(solid):
        raise ValueError("is not convex")
    return Volume(hull.equations, solid.min(0), solid.max(0))


def holder(points: np.ndarray, volumes: Sequence[Volume], margin: float) -> np.ndarray:
    """Index of the volume that holds each point [N, 3]: i32 [N], -1 none.

    Args: margin: how far outside of a volume a point may lie, in the points' unit.
    Choices: of volumes that overlap the first; of those that a point lies just outside of, the
      nearest.
    """
    owner, best = np.full(len(points), -1, np.int32), np.full(len(points), np.inf)
    columns = np.ascontiguousarray(points.T)
    for row, (faces, low, high) in enumerate(volumes):
        near = np.arange(len(points))
        for axis in (2, 0, 1):
            values = columns[axis, near]
            near = near[(values >= low[axis] - margin) & (values <= high[axis] + margin)]
        outside = np.maximum((points[near] @ faces[:, :3].T + faces[:, 3]).max(1), 0.0)
        nearer = (outside <= margin) & (outside < best[near])
        best[near[nearer]], owner[near[nearer]] = outside[nearer], row
    return owner
