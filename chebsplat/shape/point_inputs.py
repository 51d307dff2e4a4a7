"""Inputs of the point encoder: shape of a cloud of points at several radii, without appearance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
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
N_TRIED, TRIED = 128, 0.3  # points whose `truncation` is measured, and the radius, metres


class PointInputs(NamedTuple):
    """Of N points, in metres, z up; S radii.

    own:         f32 [N, 6]: height above the floor; normal · up and its size; standard deviations
      along the least and the middle axis of the local covariance over that along the largest;
      logarithm of that.
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
      means:       [N, 3] scene units, float64; normals [N, 3] unit, towards a camera; covariances
        [N, 3, 3].
      up:          [3] against gravity; unit: scene units in a metre.
      describe:    of the descriptors, the defaults if None.
      n_neighbors: K, at most 31; n_scales: S, of the first radii.
    Raises: ValueError on values that are not finite, or no unit at all.
    Choices: a neighbourhood of radius r is of points of which a cube of edge 0.36 r keeps one, so
      that K of them reach as far as r however dense the cloud is; the nearest K to 1.3 r are taken.
      Descriptors are of the point itself in the region of its 31 nearest of these: Eq 9 is exact at
      a region's centre. Covariances only shape the metric and three ratios, so that their scale
      must be that of the spacing (`splats.gaussians.local_shape`).
    """
    if not unit > 0 or not all(np.isfinite(v).all() for v in (means, normals, covariances, up)):
        raise ValueError(
            "points, normals, covariances and up must be finite, and the unit positive"
        )

    where, facing, deviations, shape = _framed(means, normals, covariances, up, unit)
    height = where[:, 2] - np.quantile(where[:, 2], FLOOR) if len(where) else where[:, 2]
    ratios = deviations[:, :2] / deviations[:, 2:]
    own = np.column_stack(
        [height, facing[:, 2], np.abs(facing[:, 2]), ratios, np.log(deviations[:, 2])]
    )
    parts = [
        _scale(where, radius, shape, describe or DescribeSection(), n_neighbors)
        for radius in RADII[:n_scales]
    ]
    neighbors, descriptors = (list(part) for part in zip(*parts, strict=True))
    return PointInputs(
        own.astype(np.float32),
        shape[0],
        facing.astype(np.float32),
        np.concatenate(descriptors, 1),
        np.stack(neighbors, 1),
    )


def truncation(
    means: np.ndarray,
    covariances: np.ndarray,
    *,
    up: np.ndarray,
    unit: float = 1.0,
    describe: DescribeSection | None = None,
) -> float | None:
    """Cost of cutting off the Chebyshev series: 1 - r, of the distances between the descriptors of
    N_TRIED points, and between these points' descriptors of twice as many degrees.

    Args: as for `point_inputs`. Returns: in [0, 2]; None where fewer than 3 points, or only points
      of one shape, are there.
    Choices: at the radius of middle size; points evenly through their order, which needs no seed.
    """
    rows = np.unique(np.linspace(0, len(means) - 1, min(N_TRIED, len(means))).round().astype(int))
    if len(rows) < 3:
        return None
    settings = describe or DescribeSection()
    where, _, _, shape = _framed(means, np.zeros_like(means), covariances, up, unit)
    members = _regions(where, TRIED, rows)[2]
    apart = []
    for degree in (settings.max_degree, 2 * settings.max_degree):
        finer = settings.model_copy(update={"max_degree": degree})
        apart.append(
            pdist(describe_members(*shape, members, finer).values[:, 0].reshape(len(rows), -1))
        )
    if min(of.std() for of in apart) < 1e-12:
        return None
    return float(1 - np.corrcoef(apart)[0, 1])


def _framed(
    means: np.ndarray, normals: np.ndarray, covariances: np.ndarray, up: np.ndarray, unit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points [N, 3] upright in metres about their centroid, their normals, standard deviations
    along the axes of their covariances, least first, and (means, quats, deviations) in single
    precision, as Gaussians.
    """
    turn = upright(up)
    where = ((means - means.mean(0)) @ turn.T) / unit if len(means) else means
    facing = normals.astype(np.float64) @ turn.T
    values, axes = np.linalg.eigh(
        np.einsum("ij,njk,lk->nil", turn, covariances.astype(np.float64), turn) / unit**2
    )
    deviations = np.sqrt(np.clip(values, 1e-14, None))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    quats = Rotation.from_matrix(axes).as_quat(scalar_first=True) if len(axes) else np.zeros((0, 4))
    shape = where.astype(np.float32), quats.astype(np.float32), deviations.astype(np.float32)
    return where, facing, deviations, shape


def _regions(
    means: np.ndarray, radius: float, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """About R points `rows` of [N, 3]: the points nearest to each that stand for a neighbourhood of
    this radius and their distances [R, MEMBERS], -1 and inf where there are fewer; and the members
    of its region [R, MEMBERS].
    """
    own = rows[:, None]
    near = np.full((len(rows), MEMBERS), -1, np.int64)
    distance = np.full((len(rows), MEMBERS), np.inf)
    if len(rows):
        sample = first_of_each(means, SPACING * radius)
        count = min(MEMBERS, len(sample))
        lengths, index = cKDTree(means[sample]).query(means[rows], count, workers=-1)
        near[:, :count] = sample[index.reshape(len(rows), count)]
        distance[:, :count] = lengths.reshape(len(rows), count)
    others = np.where((near == own) | (distance > 2 * radius), -1, near)
    order = np.argsort(others < 0, axis=1, kind="stable")
    return (
        near,
        distance,
        np.concatenate([own, np.take_along_axis(others, order, 1)[:, : MEMBERS - 1]], 1),
    )


def _scale(
    means: np.ndarray,
    radius: float,
    shape: tuple[np.ndarray, np.ndarray, np.ndarray],
    describe: DescribeSection,
    n_neighbors: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours i32 [N, K] and descriptors f32 [N, J P] at one radius."""
    near, distance, members = _regions(means, radius, np.arange(len(means)))
    neighbors = np.where(distance <= REACH * radius, near, -1)[:, :n_neighbors]
    values = describe_members(*shape, members, describe).values[:, 0]
    return neighbors.astype(np.int32), values.reshape(len(means), math.prod(values.shape[1:]))
