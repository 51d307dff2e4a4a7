"""Parts of scenes: Gaussians joined through those that touch, points by the cubes of a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

NEIGHBORS = 16  # nearest selected ones that a Gaussian is compared with
REACH = 2.0  # standard deviations along the longest axis
Corner = np.ndarray | Sequence[float] | None
FARTHEST = 2.0**40  # cubes from the origin along an axis; what lies beyond counts as there


def parts(means: np.ndarray, scales: np.ndarray, selected: np.ndarray) -> np.ndarray:
    """Number of the part of each selected Gaussian, i64 [N], the largest part 0; -1 for all others.

    Args: means [N, 3]; scales [N, 3] standard deviations, activated; both scene units; selected:
      bool [N].
    Choices: two touch if the spheres of two standard deviations along their longest axes do; each
      is compared with its 16 nearest, which is symmetrised by union. Parts of one size are in order
      of their first Gaussians.
    """
    part_of, rows = np.full(len(selected), -1, np.int64), np.flatnonzero(selected)
    n = len(rows)
    if n < 2:
        part_of[rows] = 0
        return part_of
    reach = REACH * scales[rows].max(1)
    distances, near = cKDTree(means[rows]).query(means[rows], k=min(NEIGHBORS + 1, n))
    touching = distances <= reach[:, None] + reach[near]
    starts = np.broadcast_to(np.arange(n)[:, None], near.shape)[touching]
    edges = coo_array((np.ones(len(starts), bool), (starts, near[touching])), shape=(n, n))
    _, numbers = connected_components(edges, directed=False)
    order = np.argsort(-np.bincount(numbers), kind="stable")
    part_of[rows] = np.argsort(order)[numbers]
    return part_of


def substantial(
    means: np.ndarray, scales: np.ndarray, selected: np.ndarray, least: float = 0.1
) -> np.ndarray:
    """The selected, bool [N], in parts of at least a share `least` of the largest: no crumbs."""
    numbers = parts(means, scales, selected)
    sizes = np.bincount(numbers[selected])
    mask: np.ndarray = selected.copy()
    if len(sizes):
        mask[selected] = sizes[numbers[selected]] >= least * sizes[0]
    return mask


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

    Args: cube [N]: of each point, from 0; least: share of the number of points in the median
      point's cube that a cube must hold, and three at least.
    """
    count = np.bincount(cube)
    is_dense = count >= max(3, least * np.median(count[cube]))
    sums = np.zeros((len(values), len(count), 3))
    for total, each in zip(sums, values, strict=True):
        np.add.at(total, cube, each)
    return is_dense, *(sums[:, is_dense] / count[is_dense, None])
