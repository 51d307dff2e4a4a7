"""Points by the cubes of a grid that hold them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Corner = np.ndarray | Sequence[float] | None
FARTHEST = 2.0**40  # cubes from the origin along an axis; what lies beyond counts as there


def cubes_of(points: np.ndarray, edge: float, origin: Corner = None) -> np.ndarray:
    """A number i64 [N] for the cube that holds each of points [N, 3], N > 0; in order of x, y, z.

    Args: edge: of a cube; origin [3]: a corner of cubes; None: the least coordinates. Cubes of half
      the edge lie within these.
    """
    place = np.floor((points - (points.min(0) if origin is None else np.asarray(origin))) / edge)
    place = place.clip(-FARTHEST, FARTHEST).astype(np.int64)
    place -= place.min(0)
    sides = place.max(0) + 1
    numbers: np.ndarray = (place[:, 0] * sides[1] + place[:, 1]) * sides[2] + place[:, 2]
    return numbers


def first_of_each(points: np.ndarray, edge: float, origin: Corner = None) -> np.ndarray:
    """Indices of the first of the points in each cube, in order. Args as of `cubes_of`."""
    return np.sort(np.unique(cubes_of(points, edge, origin), return_index=True)[1])


def means_of_each(cube: np.ndarray, least: float, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Cubes that hold enough points, bool [M], and of these the means of values [N, 3].

    Args: cube [N]: of each point, from 0; least: share of the number of points in the median point's cube that a
      cube must hold, and three at least.
    """
    count = np.bincount(cube)
    is_dense = count >= max(3, least * np.median(count[cube]))
    sums = np.zeros((len(values), len(count), 3))
    for total, each in zip(sums, values, strict=True):
        np.add.at(total, cube, each)
    return is_dense, *(sums[:, is_dense] / count[is_dense, None])
