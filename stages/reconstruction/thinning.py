"""Thinning of points to one a cube, of cubes of one size or smaller where colours differ."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from chebsplat.splats.parts import cubes_of, first_of_each

if TYPE_CHECKING:
    from chebsplat.formats.points import Points

LEVELS = 4  # sizes of cubes that colours choose among, each half of the one before
# variance of the colours of one surface, of channels in [0, 1], summed over the three
NOISE = 1e-3


def thin(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` points: the first in each cube, of the smallest edge for that."""
    if len(points) <= count:
        return np.arange(len(points))
    return first_of_each(points, edge_of(points, count))


def even(points: Points) -> np.ndarray:
    """Indices of evenly spaced points: of a cloud thinned by colour the first in each of its
    largest cubes, of another one all.
    """
    if "largest" not in points.notes:
        return np.arange(len(points.means))
    return first_of_each(points.means, points.notes["largest"], points.notes["from"])


def edge_of(points: np.ndarray, count: int) -> float:
    """The smallest edge of cubes, `count` at most, that hold all points [N, 3]."""
    size = float(np.ptp(points, axis=0).max()) or 1.0
    low, high = size / 4096, size
    for _ in range(24):
        middle = (low * high) ** 0.5
        low, high = (
            (middle, high) if len(np.unique(cubes_of(points, middle))) > count else (low, middle)
        )
    return high


def by_color(
    points: np.ndarray, colors: np.ndarray, count: int, edge: float
) -> tuple[np.ndarray, np.ndarray]:
    """Octree of at most `count` cubes with points [N, 3], the smaller the more the colours u8
    [N, 3] within differ: the first point of each, in order, and the cube of every point [N].

    Args: edge: of the largest cubes, which are not more than `count`.

    Choices: a cube is split while the squared deviations of its points' colours from their mean,
      plus NOISE a point, sum to more than a bound, the least that keeps to `count`. For points of
      pixels that sum is the squared error of pictures in which each cube has one colour.
    """
    values = colors / 255.0
    cube_of: list[np.ndarray] = []
    errors, parents, firsts = [], [], []
    for level in range(LEVELS):
        _, first, cube, n_points = np.unique(
            cubes_of(points, edge / 2**level),
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )
        sums = np.stack([np.bincount(cube, values[:, k]) for k in range(3)])
        squares = np.bincount(cube, (values**2).sum(1))
        errors.append(squares - (sums**2).sum(0) / n_points + NOISE * n_points)
        parents.append(cube_of[-1][first] if cube_of else np.zeros(0, np.int64))
        cube_of.append(cube)
        firsts.append(first)
    errors[-1][:] = 0.0

    def whole(bound: float) -> list[np.ndarray]:
        """Masks of each level's cubes that are leaves of the octree under this bound."""
        leaves, halved = [], np.zeros(0, bool)
        for error, parent in zip(errors, parents, strict=True):
            there = halved[parent] if len(parent) else np.ones(len(error), bool)
            halved = there & (error > bound)
            leaves.append(there & ~halved)
        return leaves

    low, high = 0.0, max(float(error.max()) for error in errors)
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (
            (middle, high) if sum(level.sum() for level in whole(middle)) > count else (low, middle)
        )
    first_of = np.empty(len(points), np.int64)  # of each point, the first one in its cube
    for cube, first, stays in zip(cube_of, firsts, whole(high), strict=True):
        inside = stays[cube]
        first_of[inside] = first[cube[inside]]
    rows, leaf = np.unique(first_of, return_inverse=True)
    return rows, leaf
