"""Local regions of a view frustum: farthest-point centres and the balls about them.

The print gives no number of centres, no radius, and no bound of a ball's points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

OVERLAP = 1.5  # radius over the least that covers all points


class Regions(NamedTuple):
    """Regions of points [P, 3].

    centers i64 [M]: the points at their centres. pairs: (point i64 [E], region i64 [E]), one for
    each point in a ball. members i64 [M, n], -1 where padded: those that the region is encoded
    from, its centre first. radius: scene units.
    """

    centers: Tensor
    pairs: tuple[Tensor, Tensor]
    members: Tensor
    radius: float

    def nearest(self, points: Tensor) -> Tensor:
        """Of each point, the region [P] whose centre is nearest, -1 in no ball."""
        distances = torch.full((len(points),), torch.inf, dtype=points.dtype)
        point, region = self.pairs
        apart = (points[point] - points[self.centers[region]]).norm(dim=-1)
        distances.scatter_reduce_(0, point, apart, "amin")
        closest = torch.full((len(points),), -1, dtype=torch.int64)
        is_closest = apart == distances[point]
        closest[point[is_closest]] = region[is_closest]
        return closest


def regions_of(points: Tensor, count: int, size: int, generator: torch.Generator) -> Regions:
    """Regions N(c) = {p : |p - c| <= r} of points [P, 3] about `count` farthest points.

    Choices: r is OVERLAP times the covering radius of the centres, so that every point lies in a
      ball. A ball may hold thousands of points; its shape is encoded from its centre and `size` - 1
      others drawn at random, anew at each call, and all its points receive the encoding.
    """
    places = points.detach().double().numpy()
    n_points = len(places)
    count = min(count, n_points)
    none = torch.zeros(0, dtype=torch.int64)
    if count == 0:
        return Regions(none, (none, none), torch.zeros(0, size, dtype=torch.int64), 0.0)
    start = int(torch.randint(n_points, (1,), generator=generator))
    centers = _farthest_points(places, count, start)
    tree = cKDTree(places)
    reach = cKDTree(places[centers]).query(places)[0].max()
    radius = float(OVERLAP * reach) or 1.0
    balls = tree.query_ball_point(places[centers], radius)
    lengths = np.array([len(ball) for ball in balls])
    point = torch.from_numpy(np.concatenate(balls).astype(np.int64))
    region = torch.from_numpy(np.repeat(np.arange(len(centers)), lengths))
    middle = torch.from_numpy(centers)
    members = _drawn_members(middle, point, region, size, generator)
    return Regions(middle, (point, region), members, radius)


def _farthest_points(places: np.ndarray, count: int, start: int) -> np.ndarray:
    """Indices [M] of points, each the farthest from those before; fewer where points coincide."""
    centered = (places - places.mean(0)).astype(np.float32)
    x, y, z = np.ascontiguousarray(centered.T)
    distances, picked = np.full(len(places), np.inf, np.float32), np.empty(count, np.int64)
    for k in range(count):
        picked[k] = start
        squares = np.square(x - x[start]) + np.square(y - y[start]) + np.square(z - z[start])
        np.minimum(distances, squares, out=distances)
        start = int(distances.argmax())
    first = np.unique(centered[picked], axis=0, return_index=True)[1]
    distinct: np.ndarray = picked[np.sort(first)]
    return distinct


def _drawn_members(
    centers: Tensor, point: Tensor, region: Tensor, size: int, generator: torch.Generator
) -> Tensor:
    """members i64 [M, size]: of each ball its centre, then others in random order, -1 beyond."""
    order = torch.rand(len(point), generator=generator)
    order[point == centers[region]] = -1.0
    order = torch.argsort(order, stable=True)
    order = order[torch.argsort(region[order], stable=True)]
    point, region = point[order], region[order]
    first = torch.searchsorted(region, torch.arange(len(centers)))
    rank = torch.arange(len(point)) - first[region]
    members = torch.full((len(centers), size), -1, dtype=torch.int64)
    drawn = rank < size
    members[region[drawn], rank[drawn]] = point[drawn]
    return members
