"""Regions that break the printed descriptor (Eqs 1-6; docs/method.md, section 2).

Errors are those of one region's float32 descriptor against 60 digits, relative to the region's
largest value.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.stability import oracle
from benchmarks.stability.case import Outcome, case, relative
from chebsplat.shape.described import Descriptor
from chebsplat.shape.descriptor import describe
from chebsplat.splats.rotations import rotation_matrices

TOLERANCE = 5e-6  # the worst that any case may reach in float32
TOLERANCE_64 = 1e-12  # the same in float64, unless a case says why not


class Region(NamedTuple):
    means: np.ndarray  # [n, 3]
    scales: np.ndarray  # [n, 3]
    rotmats: np.ndarray  # [n, 3, 3]


def cloud(n: int = 16, seed: int = 0) -> Region:
    """A flattened cloud of flat Gaussians, about 1 wide."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3)) * [1.0, 0.7, 0.2]
    scales = rng.random((n, 3)) * [0.3, 0.2, 0.02] + 0.01
    return Region(
        means, scales, rotation_matrices(torch.from_numpy(rng.normal(size=(n, 4)))).numpy()
    )


def lattice(*counts: int) -> np.ndarray:
    axes = [np.arange(c, dtype=np.float64) for c in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def upright(means: np.ndarray, scale: float = 0.3) -> Region:
    """Equal round Gaussians in line with the axes: the more symmetric, the more degenerate."""
    return Region(means, np.full(means.shape, scale), np.tile(np.eye(3), (len(means), 1, 1)))


def ours(
    region: Region, dtype: torch.dtype = torch.float32, pad: int = 0, **options: Any
) -> np.ndarray:
    """Our descriptor [n, J, D - 1]. ValueError if a second run differs, or padding is not zero."""
    n = len(region.means)
    padded = [
        torch.from_numpy(np.concatenate([v, np.full((pad, *v.shape[1:]), 7.0)]))[None]
        for v in region
    ]
    mask = torch.arange(n + pad)[None] < n
    values, again = (
        describe(*padded, mask, Descriptor(**options), dtype=dtype).values[0] for _ in range(2)
    )
    if not torch.equal(values, again):
        raise ValueError("a second run gives other bits, or NaN")
    if not (values[n:] == 0).all():
        raise ValueError("padding is not zero")
    return values[:n].detach().double().numpy()


def compare(
    region: Region, pad: int = 0, tolerance_64: float = TOLERANCE_64, **options: Any
) -> Outcome:
    """Ours, in two orders of Gaussians, against 60 digits. ValueError if float64 is too far off."""
    exact = oracle.describe(*region, **options)
    order = np.random.default_rng(2).permutation(len(region.means))
    shuffled = Region(*(v[order] for v in region))
    error = max(
        relative(ours(region, pad=pad, **options), exact),
        relative(ours(shuffled, pad=pad, **options), exact[order]),
    )
    double = relative(ours(region, torch.float64, pad=pad, **options), exact)
    if not double <= tolerance_64:
        raise ValueError(f"float64 differs by {double:.1e}, more than {tolerance_64:.0e}")
    return Outcome(error, TOLERANCE)


def stretched(change: Callable[[np.ndarray], Any]) -> Region:
    region = cloud()
    return region._replace(scales=change(region.scales))


def far_pairs() -> Region:
    means = np.repeat(np.random.default_rng(0).normal(size=(16, 3)) * 1e4, 2, 0)
    means[1::2] += np.random.default_rng(1).normal(size=(16, 3)) * 0.3
    return cloud(32)._replace(means=means)


def far_clusters() -> Region:
    region = cloud(20)
    return region._replace(means=region.means + 1e3 * (np.arange(20) % 2)[:, None])


def outlier(distance: float) -> Region:
    region = cloud()
    region.means[-1] = distance
    return region


def place(units: float = 1.0, offset: float = 0.0) -> Region:
    means, scales, rotmats = cloud()
    return Region(means * units + offset, scales * units, rotmats)


STRETCHES: dict[str, Callable[[np.ndarray], Any]] = {
    "needles 1e6": lambda s: s * [1e6, 1, 1],
    "pancakes 1e6": lambda s: s * [1e6, 1e6, 1],
    "one axis 0": lambda s: s * [1, 1, 0],
    "needles of no width": lambda s: s * [1e6, 0, 0],
    "all scales 0": lambda s: s * 0,
    "all scales 0 but one": lambda s: s * (np.arange(len(s)) == 3)[:, None],
    "scales 1e-6 to 1e6": lambda s: 10.0 ** np.linspace(-6, 6, s.size).reshape(s.shape),
    "scales 1e+150": lambda s: s * 1e150,
    "scales 1e-150": lambda s: s * 1e-150,
    "scales 1e-150 to 1e150": lambda s: 10.0 ** np.linspace(-150, 150, s.size).reshape(s.shape),
}
SYMMETRIC: dict[str, Callable[[], Region]] = {  # eigenspaces of many dimensions
    "coincident": lambda: cloud()._replace(means=np.full((16, 3), 0.3)),
    "coincident and round": lambda: upright(np.full((16, 3), 0.3)),
    "half of them coincident": lambda: cloud()._replace(means=np.repeat(cloud(8).means, 2, 0)),
    "collinear": lambda: cloud()._replace(means=cloud().means * [1, 0, 0]),
    "collinear and round": lambda: upright(lattice(16, 1, 1)),
    "coplanar": lambda: cloud()._replace(means=cloud().means * [1, 1, 0]),
    "square lattice": lambda: upright(lattice(5, 5, 1)),
    "square lattice of pancakes": lambda: upright(lattice(5, 5, 1))._replace(
        scales=np.tile([0.4, 0.4, 0.01], (25, 1))
    ),
    "cubic lattice": lambda: upright(lattice(3, 3, 3)),
    "ring": lambda: upright(
        np.stack([f(np.arange(16) * np.pi / 8) for f in (np.cos, np.sin, np.zeros_like)], -1)
    ),
}
REGIONS: dict[str, Callable[[], Region]] = {
    **{name: partial(stretched, change) for name, change in STRETCHES.items()},
    **SYMMETRIC,
    "far pairs": far_pairs,
    "two far clusters": far_clusters,
    **{f"one outlier at {distance:.0e}": partial(outlier, distance) for distance in (1e4, 1e8)},
    **{f"units {units:.0e}": partial(place, units) for units in (1e-150, 1e-30, 1e30, 1e150)},
    **{f"offset {offset:.0e}": partial(place, 1.0, offset) for offset in (1e6, 1e9)},
}


@case("{name}", name=REGIONS)
def extreme(name: str) -> Outcome:
    # The axis of far clusters is parted from the next by 1e-7 of the variance, so float64 knows it
    # to 1e-9 only.
    return compare(
        REGIONS[name](), tolerance_64=1e-9 if name == "two far clusters" else TOLERANCE_64
    )


@case("an edge of 1e-200")
def faint_edge() -> Outcome:
    region = Region(
        np.array([[-1.0, 0, 0], [1.0, 0, 0]]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1))
    )
    return compare(region, bandwidth=float(2 / np.sqrt(np.log(1e200))))


# settings


@case("sigma {bandwidth:.0e}", bandwidth=[1e-6, 1e-4, 1e-2, 1e2, 1e6])
def bandwidths(bandwidth: float) -> Outcome:
    return compare(cloud(), bandwidth=bandwidth)


@case("a {anisotropy:.0e}", anisotropy=[0.0, 1e-12, 1e6, 1e12])
def anisotropies(anisotropy: float) -> Outcome:
    return compare(cloud(), anisotropy=anisotropy)


@case(
    "sigma {bandwidth:.0e}, a {anisotropy:.0e}, needles",
    bandwidth=[1e-6, 1e6],
    anisotropy=[1e-12, 1e12],
)
def both(bandwidth: float, anisotropy: float) -> Outcome:
    region = cloud()
    region = region._replace(scales=region.scales * [1e6, 1, 1])
    return compare(region, bandwidth=bandwidth, anisotropy=anisotropy)


# few, broken, and padded


@case("n = {n}, padded to 64", n=[0, 1, 2, 3, 16])
def padded(n: int) -> Outcome:
    region = cloud(n)
    outcome = compare(region, pad=64 - n)
    bare = relative(ours(region), ours(region, pad=64 - n)) if n else 0.0
    return outcome._replace(error=max(outcome.error, bare))


@case("one {bad} in the {field}", bad=[np.nan, np.inf], field=Region._fields)
def one_broken(bad: float, field: str) -> Outcome:
    """The row is zero, its neighbours are as without it, the region beside it keeps every bit."""
    clean, other, rest = cloud(), cloud(seed=1), np.delete(np.arange(16), 5)
    broken = Region(*(v.copy() for v in clean))
    getattr(broken, field)[5].flat[1] = bad
    both = [torch.from_numpy(np.stack(v)) for v in zip(broken, other, strict=True)]
    values = describe(*both, torch.ones(2, 16, dtype=torch.bool)).values.double().numpy()
    if (values[0, 5] != 0).any() or not np.array_equal(values[1], ours(other)):
        raise ValueError("the broken row is not zero, or the region beside it has changed")
    error = relative(values[0, rest], oracle.describe(*(v[rest] for v in clean)))
    return Outcome(error, TOLERANCE)


@case("every Gaussian NaN")
def all_broken() -> Outcome:
    region = cloud()
    values = ours(region._replace(means=region.means * np.nan))
    return Outcome(relative(values, np.zeros_like(values)), 0.0)


# gradients


@case(
    "gradient on {name}",
    name=["square lattice", "cubic lattice", "coincident and round", "collinear", "far pairs"],
)
def gradient(name: str) -> Outcome:
    """Share of gradient entries that are not finite."""
    means, *rest = (torch.from_numpy(v)[None] for v in REGIONS[name]())
    means.requires_grad_(True)
    values = describe(means, *rest, torch.ones(means.shape[:2], dtype=torch.bool)).values
    (slope,) = torch.autograd.grad(values.square().sum(), means)
    return Outcome(float(1 - torch.isfinite(slope).double().mean()), 0.0)
