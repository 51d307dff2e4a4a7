"""What the point encoder sees of a cloud of points: shape at several radii, and nothing of what it looks like."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from chebsplat.cameras import upright
from chebsplat.settings import DescribeSection
from chebsplat.shape.descriptor import describe_members
from chebsplat.splats.parts import first_of_each

RADII = (0.12, 0.3, 0.7, 1.6)  # metres
N_OWN = 6
SPACING = 0.36  # of a radius, between the points that stand for a neighbourhood of it
REACH = 1.3  # of a radius, to the farthest neighbour
MEMBERS = 32  # of the region that a descriptor is of
FLOOR = 0.005  # quantile of heights


class PointInputs(NamedTuple):
    """Of N points, in metres, z up; S radii.

    own:         f32 [N, 6]: height above the floor; normal · up and its size; standard deviations along the least and
                 the middle axis of the local covariance over that along the largest; logarithm of that.
    means:       f32 [N, 3] about their centroid; normals: f32 [N, 3].
    descriptors: f32 [N, S J P], of the point itself in a region about it, by radius.
    neighbors:   i32 [N, S, K] rows of points, -1 where a radius holds fewer.
    """

    own: np.ndarray
    means: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray
    neighbors: np.ndarray


def point_inputs(
    means: np.ndarray,
    normals: np.ndarray,
    covariances: np.ndarray,
    *,
    up: np.ndarray,
    unit: float = 1.0,
    describe: DescribeSection | None = None,
    n_neighbors: int = 24,
    n_scales: int = len(RADII),
) -> PointInputs:
    """Inputs of every point.

    Args:
      means:       [N, 3] scene units, float64; normals [N, 3] unit, towards a camera; covariances [N, 3, 3].
      up:          [3] against gravity; unit: scene units in a metre.
      describe:    of the descriptors, the defaults if None.
      n_neighbors: K, at most 31; n_scales: S, of the first radii.
    Raises: ValueError on values that are not finite, or no unit at all.
    Choices: a neighbourhood of radius r is of points of which a cube of edge 0.36 r keeps one, so that K of them reach
      as far as r however dense the cloud is; the nearest K to 1.3 r are taken. Descriptors are of the point itself in
      the region of its 31 nearest of these: Eq 9 is exact at a region's centre. Covariances only shape the metric and
      three ratios, so that their scale must be that of the spacing (`splats.gaussians.local_shape`).
    """
    if not unit > 0 or not all(np.isfinite(v).all() for v in (means, normals, covariances, up)):
        raise ValueError("points, normals, covariances and up must be finite, and the unit positive")

    turn = upright(up)
    where = ((means - means.mean(0)) @ turn.T) / unit if len(means) else means
    facing = normals.astype(np.float64) @ turn.T
    values, axes = np.linalg.eigh(np.einsum("ij,njk,lk->nil", turn, covariances.astype(np.float64), turn) / unit**2)
    deviations = np.sqrt(np.clip(values, 1e-14, None))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    quats = Rotation.from_matrix(axes).as_quat(scalar_first=True) if len(axes) else np.zeros((0, 4))
    height = where[:, 2] - np.quantile(where[:, 2], FLOOR) if len(where) else where[:, 2]
    ratios = deviations[:, :2] / deviations[:, 2:]
    own = np.column_stack([height, facing[:, 2], np.abs(facing[:, 2]), ratios, np.log(deviations[:, 2])])
    shape = where.astype(np.float32), quats.astype(np.float32), deviations.astype(np.float32)
    parts = [_scale(where, radius, shape, describe or DescribeSection(), n_neighbors) for radius in RADII[:n_scales]]
    neighbors, descriptors = (list(part) for part in zip(*parts, strict=True))
    return PointInputs(
        own.astype(np.float32),
        shape[0],
        facing.astype(np.float32),
        np.concatenate(descriptors, 1),
        np.stack(neighbors, 1),
    )


def _scale(
    means: np.ndarray,
    radius: float,
    shape: tuple[np.ndarray, np.ndarray, np.ndarray],
    describe: DescribeSection,
    n_neighbors: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours i32 [N, K] and descriptors f32 [N, J P] at one radius."""
    n = len(means)
    own = np.arange(n)[:, None]
    near = np.full((n, MEMBERS), -1, np.int64)
    distance = np.full((n, MEMBERS), np.inf)
    if n:
        sample = first_of_each(means, SPACING * radius)
        count = min(MEMBERS, len(sample))
        found, index = cKDTree(means[sample]).query(means, count, workers=-1)
        near[:, :count] = sample[index.reshape(n, count)]
        distance[:, :count] = found.reshape(n, count)
    neighbors = np.where(distance <= REACH * radius, near, -1)[:, :n_neighbors]
    others = np.where((near == own) | (distance > 2 * radius), -1, near)
    order = np.argsort(others < 0, axis=1, kind="stable")
    members = np.concatenate([own, np.take_along_axis(others, order, 1)[:, : MEMBERS - 1]], 1)
    values = describe_members(*shape, members, describe).values[:, 0]
    return neighbors.astype(np.int32), values.reshape(n, math.prod(values.shape[1:]))
