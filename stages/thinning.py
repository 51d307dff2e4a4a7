"""Fewer points, evenly in space: one a cube."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def thin(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` points, the first in each cube of the smallest edge that allows it."""
    import numpy as np

    if len(points) <= count:
        return np.arange(len(points))
    return np.sort(cubes(points, count)[0])


def cubes(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most `count` cubes that hold points [N, 3], of the smallest edge that allows it: the first point of each, the
    cube of every point [N], and how many points each holds.
    """
    import numpy as np

    origin = points.min(0)
    size = float(np.ptp(points, axis=0).max()) or 1.0

    def flat(edge: float) -> np.ndarray:
        cells = np.floor((points - origin) / edge).astype(np.int64)
        sides = cells.max(0) + 1
        numbers: np.ndarray = (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
        return numbers

    low, high = size / 4096, size
    for _ in range(24):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if len(np.unique(flat(middle))) > count else (low, middle)
    _, first, cube, held = np.unique(flat(high), return_index=True, return_inverse=True, return_counts=True)
    return first, cube, held
