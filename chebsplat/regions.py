"""Regions of Gaussians: farthest-point centres, bounded neighbourhoods, and which regions cover a point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Regions(NamedTuple):
    """centers i64 [M] are indices of points; members i64 [M, n], -1 where padded, the centre first.
    radius: scene units; no member is farther from its centre, and it is at least the centres' covering radius.
    """

    centers: np.ndarray
    members: np.ndarray
    radius: float


def build_regions(means: np.ndarray, n_regions: int, region_size: int, seed: int = 0) -> Regions:
    """Cover points with regions (METHOD: sampling).

    Args:
      means:       [N, 3] scene units.
      n_regions:   how many, at most N; region_size: how many members, at most.
      seed:        of the first centre and of the thinning.
    Returns: regions; zero of them for N = 0.
    Raises:  ValueError on sizes below 1 or non-finite means.
    Choices: centres by farthest-point sampling; the radius is 1.5 times the covering radius, so that regions
      overlap. Neighbours come from a thinned set of about `region_size` points a ball, else a region of the nearest
      ones would shrink to a speck inside a dense ball; the centre itself is always a member.
    """
    if n_regions < 1 or region_size < 1:
        raise ValueError("n_regions and region_size must be at least 1")
    if not np.isfinite(means).all():
        raise ValueError("means are not finite")
    n = len(means)
    if n == 0:
        return Regions(np.zeros(0, np.int64), np.zeros((0, region_size), np.int64), 0.0)
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    centers = _farthest_points(means, min(n_regions, n), int(rng.integers(n)))
    where = means[centers]
    reach, _ = cKDTree(where).query(means, workers=-1)
    radius = 1.5 * float(reach.max()) or 1.0
    ball = np.array([len(x) for x in cKDTree(means).query_ball_point(where[:64], radius, workers=-1)])
    share = min(1.0, region_size / max(float(np.median(ball)), 1.0))
    thinned = np.sort(rng.permutation(n)[: max(int(np.ceil(share * n)), min(n, region_size))])
    k = min(region_size, len(thinned))
    distance, index = cKDTree(means[thinned]).query(where, k, distance_upper_bound=radius * (1 + 1e-9), workers=-1)
    distance, index = distance.reshape(len(where), k), index.reshape(len(where), k)
    found = np.where(np.isfinite(distance), thinned[np.minimum(index, len(thinned) - 1)], -1)
    members = np.full((len(where), region_size), -1, np.int64)
    members[:, :k] = found
    return Regions(centers, _centre_first(members, centers), radius)


def covering(points: np.ndarray, centers: np.ndarray, radius: float, n_covers: int) -> np.ndarray:
    """The nearest regions whose ball holds each point: i64 [N, n_covers], -1 where fewer do."""
    from scipy.spatial import cKDTree

    if len(centers) == 0 or len(points) == 0:
        return np.full((len(points), n_covers), -1, np.int64)
    distance, index = cKDTree(centers).query(points, n_covers, distance_upper_bound=radius, workers=-1)
    distance, index = distance.reshape(len(points), n_covers), index.reshape(len(points), n_covers)
    return np.where(np.isfinite(distance), index, -1)


def _farthest_points(means: np.ndarray, count: int, start: int) -> np.ndarray:
    import fpsample

    points = np.ascontiguousarray(means - means.mean(0), np.float32)
    if count == len(means):
        return np.arange(count)
    height = int(np.clip(np.log2(max(len(points), 2)) - 4, 1, 9))
    picked = fpsample.bucket_fps_kdline_sampling(points, count, height, start)
    return np.unique(np.asarray(picked, np.int64))


def _centre_first(members: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Put each centre in front; where it was thinned away, it replaces the farthest member."""
    rest = np.where(members == centers[:, None], -1, members)
    order = np.argsort(rest < 0, axis=1, kind="stable")
    rest = np.take_along_axis(rest, order, 1)
    return np.concatenate([centers[:, None], rest[:, : members.shape[1] - 1]], 1)
