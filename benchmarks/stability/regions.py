"""Point sets that break naive farthest-point sampling (docs/method.md, section 2).

Errors are the covering radius of our centres over that of exact sampling, minus 1 (from another
first point, which alone moves it by a tenth).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.stability.case import Outcome, case
from chebsplat.settings import DescribeSection
from chebsplat.shape.regions import regions_of

N_REGIONS, SIZE = 24, 16
TOLERANCE = 0.25


def box(n: int = 600) -> np.ndarray:
    return np.random.default_rng(0).random((n, 3))


def with_outlier(distance: float) -> np.ndarray:
    means = box()
    means[-1] = distance
    return means


POINTS: dict[str, Callable[[], np.ndarray]] = {
    "1 point": lambda: box(1),
    "2 points": lambda: box(2),
    "offset 1e+06": lambda: box() + 1e6,
    "offset 1e+09": lambda: box() + 1e9,
    "an outlier at 1e+04": lambda: with_outlier(1e4),
    "an outlier at 1e+08": lambda: with_outlier(1e8),
    "units 1e-15": lambda: box() * 1e-15,
    "units 1e+15": lambda: box() * 1e15,
    "half of them coincident": lambda: np.repeat(box(300), 2, 0),
    "all coincident": lambda: np.full((600, 3), 0.3),
    "collinear": lambda: box() * [1, 0, 0],
    "coplanar": lambda: box() * [1, 1, 0],
    "cubic lattice": lambda: np.stack(
        np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), -1
    ).reshape(-1, 3),
    "half of them in a speck": lambda: np.concatenate([box(300) * 1e-6, box(600)[300:]]),
}


def farthest(means: np.ndarray, count: int) -> list[int]:
    """Exact sampling from the first point on."""
    means, picked = means.astype(np.longdouble), [0]
    nearest = ((means - means[0]) ** 2).sum(1)
    for _ in range(min(count, len(means)) - 1):
        picked.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((means - means[picked[-1]]) ** 2).sum(1))
    return picked


def reach(means: np.ndarray, centers: Any) -> float:
    """The largest distance of a point from its nearest centre."""
    means = means.astype(np.longdouble)
    return float(np.sqrt(((means[:, None] - means[centers]) ** 2).sum(-1).min(1).max()))


@case("{name}", name=POINTS)
def points(name: str) -> Outcome:
    """Raises ValueError on members that repeat, lie beyond the radius, or have no centre first."""
    means = POINTS[name]()
    regions = regions_of(means, DescribeSection(n_regions=N_REGIONS, region_size=SIZE))
    present = regions.members >= 0
    distance = np.linalg.norm(means[regions.members] - means[regions.centers][:, None], axis=-1)
    unique = all(
        len(np.unique(row[here])) == here.sum()
        for row, here in zip(regions.members, present, strict=True)
    )
    covered = reach(means, regions.centers)
    if not unique or (regions.members[:, 0] != regions.centers).any():
        raise ValueError("members are not unique, or not led by their centre")
    if (distance[present] > regions.radius * (1 + 1e-6)).any() or covered > regions.radius:
        raise ValueError("a member or a point lies beyond the radius")
    exact = reach(means, farthest(means, N_REGIONS))
    return Outcome(max(covered / exact - 1, 0.0) if exact else covered, TOLERANCE)
