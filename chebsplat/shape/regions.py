"""Regions of Gaussians: farthest-point centres and bounded neighbourhoods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.settings import DescribeSection
from chebsplat.shape.regions_kernel import pick_farthest

SAMPLE = 65536  # points that stand for all in estimates of density


class Regions(NamedTuple):
    """centers i64 [M] are indices of points, in farthest-point order; members i64 [M, n], -1 where
    padded, the centre first. radius: scene units; no member is farther from its centre, and it is
    at least the centres' covering radius. share: the part of all points that members were taken
    from.
    """

    centers: np.ndarray
    members: np.ndarray
    radius: float
    share: float = 1.0


def regions_of(means: np.ndarray, settings: DescribeSection) -> Regions:
    """Cover points with regions (docs/method.md, section 2).

    Args:
      means:       [N, 3] scene units; float64 where the scene is far from the origin.
      settings:    how many regions and members at most; the seed of the first centre and of the
        thinning; the radius over the covering radius.
    Returns: regions; zero of them for N = 0, fewer than n_regions where points coincide.
    Raises:  ValueError on non-finite means.
    Choices: centres by farthest-point sampling; the radius is `overlap` times the covering radius,
      so that regions overlap. Neighbours come from a thinned set of about `region_size` points a
      ball, else a region of the nearest ones would shrink to a speck inside a dense ball; the
      centre itself is always a member. A point is thinned away by a hash of its index.
    """
    region_size = settings.region_size
    if not np.isfinite(means).all():
        raise ValueError("means are not finite")
    n = len(means)
    n_regions = min(settings.n_regions, n)
    if n == 0:
        return Regions(np.zeros(0, np.int64), np.zeros((0, region_size), np.int64), 0.0)
    keys = _uniform(np.arange(n), settings.seed)
    start = int(np.random.default_rng(settings.seed).integers(n))
    centers, reach = farthest_points(means, n_regions, start)
    radius = settings.overlap * reach or 1.0
    share = _share(means, centers, radius, region_size, keys)
    return Regions(
        centers, _neighbourhoods(means, centers, radius, share, region_size, keys), radius, share
    )


def farthest_points(means: np.ndarray, count: int, start: int) -> tuple[np.ndarray, float]:
    """Indices [M] of points, each the farthest from those before it, and their covering radius.

    Choices: the first is `start`; M < count where only coincident points are left. Exact in float32
      around the centroid.
    """
    n = len(means)
    points = means - means.mean(0, dtype=np.float64)
    extent = float(np.abs(points).max())
    points = np.ascontiguousarray(points / (extent or 1.0), np.float32)
    n_picks = min(count + 1, n)  # one more: its distance is the covering radius
    order = _tree(points).indices
    picked = order[pick_farthest(points[order], n_picks, int(np.flatnonzero(order == start)[0]))]
    _, first = np.unique(points[picked], axis=0, return_index=True)
    picked = picked[np.sort(first)]
    centers = picked[:count]
    if len(picked) == len(centers):
        return centers, 0.0
    return centers, float(np.linalg.norm(means[centers] - means[picked[count]], axis=1).min())


def _share(
    means: np.ndarray, centers: np.ndarray, radius: float, region_size: int, keys: np.ndarray
) -> float:
    """The part of the points that leaves the median ball `region_size` of them."""
    n = len(means)
    sample = means if n <= SAMPLE else means[np.argpartition(keys, SAMPLE)[:SAMPLE]]
    counts = _tree(sample).query_ball_point(
        means[centers[:64]], radius, workers=-1, return_length=True
    )
    ball = float(np.median(counts)) * n / len(sample)
    return min(1.0, max(region_size / max(ball, 1.0), min(n, region_size) / n))


def _neighbourhoods(
    means: np.ndarray,
    centers: np.ndarray,
    radius: float,
    share: float,
    region_size: int,
    keys: np.ndarray,
) -> np.ndarray:
    """members i64 [M, region_size]: the centre, then the nearest thinned points in the radius."""
    thinned = np.flatnonzero(keys < share)
    where = means[centers]
    k = min(region_size, max(len(thinned), 1))
    members = np.full((len(where), region_size), -1, np.int64)
    if len(thinned):
        distance, index = _tree(means[thinned]).query(
            where, k, distance_upper_bound=radius * (1 + 1e-9), workers=-1
        )
        distance, index = distance.reshape(len(where), k), index.reshape(len(where), k)
        members[:, :k] = np.where(
            np.isfinite(distance), thinned[np.minimum(index, len(thinned) - 1)], -1
        )
    return _centre_first(members, centers)


def _tree(points: np.ndarray) -> cKDTree:
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _uniform(ids: np.ndarray, seed: int) -> np.ndarray:
    """A number in [0, 1) for each id and seed, by mixing all their bits."""
    x = np.asarray(ids, np.uint64) + np.uint64(1 + (seed << 32) % 2**63)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    return (x ^ (x >> np.uint64(31))).astype(np.float64) / 2.0**64


def _centre_first(members: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Put each centre in front; where it was thinned away, it replaces the farthest member."""
    rest = np.where(members == centers[:, None], -1, members)
    order = np.argsort(rest < 0, axis=1, kind="stable")
    rest = np.take_along_axis(rest, order, 1)
    return np.concatenate([centers[:, None], rest[:, : members.shape[1] - 1]], 1)
