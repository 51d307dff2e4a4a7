"""Regions that break the printed descriptor (Eqs 1-6; docs/method.md, section 2).

Errors are those of one region's float32 descriptor against 60 digits, relative to the region's largest value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.stability import oracle
from benchmarks.stability.case import Outcome, case, naive, relative
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
    return Region(means, scales, rotation_matrices(torch.from_numpy(rng.normal(size=(n, 4)))).numpy())


def lattice(*counts: int) -> np.ndarray:
    axes = [np.arange(c, dtype=np.float64) for c in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def upright(means: np.ndarray, scale: float = 0.3) -> Region:
    """Equal round Gaussians in line with the axes: the more symmetric, the more degenerate."""
    return Region(means, np.full(means.shape, scale), np.tile(np.eye(3), (len(means), 1, 1)))


def ours(region: Region, dtype: torch.dtype = torch.float32, pad: int = 0, **options: Any) -> np.ndarray:
    """Our descriptor [n, J, D - 1]. Raises ValueError if a second run gives other bits, or padding is not zero."""
    n = len(region.means)
    padded = [torch.from_numpy(np.concatenate([v, np.full((pad, *v.shape[1:]), 7.0)]))[None] for v in region]
    mask = torch.arange(n + pad)[None] < n
    found, again = (describe(*padded, mask, dtype=dtype, **options).values[0] for _ in range(2))
    if not torch.equal(found, again):
        raise ValueError("a second run gives other bits, or NaN")
    if not (found[n:] == 0).all():
        raise ValueError("padding is not zero")
    return found[:n].detach().double().numpy()


def printed(
    region: Region, dtype: type, n_eigs: int = 16, beta: float = 30.0, bandwidth: float = 0.7, max_degree: int = 8
) -> np.ndarray:
    """Eqs 1-6 as they stand: [n, D + 1], without rotations."""
    means, scales, R = (v.astype(dtype) for v in region)
    covariances = R @ (scales[:, :, None] ** 2 * R.transpose(0, 2, 1))
    metric = np.linalg.inv(np.eye(3, dtype=dtype) + dtype(beta) * covariances)
    delta = means[:, None] - means[None]
    lengths = np.einsum("ijk,ikl,ijl->ij", delta, metric, delta)
    weights = np.exp(-(lengths + lengths.T) / dtype(2 * bandwidth**2))
    np.fill_diagonal(weights, 0)
    laplacian = np.eye(len(means), dtype=dtype) - weights / weights.sum(1, keepdims=True)
    values, vectors = np.linalg.eig(laplacian)
    order = np.argsort(values.real)[:n_eigs]
    values, vectors = values.real[order], vectors.real[:, order]
    x = 2 * values / values[-1] - 1
    before, term = np.ones_like(x), x
    columns = [before, term]
    for _ in range(2, max_degree + 1):
        before, term = term, 2 * x * term - before
        columns.append(term)
    return np.stack([(t * vectors**2).sum(1) for t in columns], -1)


def as_printed(region: Region, **options: Any) -> str:
    """What float32 makes of the printed formula, and how much float64 or another order of Gaussians changes it."""

    def attempt() -> str:
        single = printed(region, np.float32, **options)
        bad = 1 - np.isfinite(single).mean()
        if bad:
            return f"{100 * bad:.0f} % NaN"
        double = printed(region, np.float64, **options)
        order = np.random.default_rng(1).permutation(len(region.means))
        shuffled = printed(Region(*(v[order] for v in region)), np.float64, **options)
        return f"f32 {relative(single, double):.0e}, order {relative(shuffled, double[order]):.0e}"

    return naive(attempt)


def compare(
    region: Region, condition: str, pad: int = 0, tolerance_64: float = TOLERANCE_64, **options: Any
) -> Outcome:
    """Ours, in two orders of the Gaussians, against 60 digits. Raises ValueError if float64 misses its tolerance."""
    exact = oracle.describe(*region, **options)
    order = np.random.default_rng(2).permutation(len(region.means))
    shuffled = Region(*(v[order] for v in region))
    error = max(
        relative(ours(region, pad=pad, **options), exact), relative(ours(shuffled, pad=pad, **options), exact[order])
    )
    double = relative(ours(region, torch.float64, pad=pad, **options), exact)
    if not double <= tolerance_64:
        raise ValueError(f"float64 differs by {double:.1e}, more than {tolerance_64:.0e}")
    given = {name: value for name, value in options.items() if name == "bandwidth"}
    beta = {"beta": options["anisotropy"]} if "anisotropy" in options else {}
    return Outcome(condition, as_printed(region, **given, **beta), error, TOLERANCE)


def aspect(scales: np.ndarray) -> str:
    largest, least = scales.max(), scales.min()
    return f"s max/min {largest / least:.0e}" if least > 0 else f"s max {largest:.0e}, min 0"


# shapes of the Gaussians

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


@case("{name}", name=STRETCHES)
def stretched(name: str) -> Outcome:
    region = cloud()
    region = region._replace(scales=STRETCHES[name](region.scales))
    return compare(region, aspect(region.scales))


# the printed metric, of scales in scene units, turned about the world's axis

PRINTED: dict[str, Callable[[Region], Region]] = {
    "scales 1e-20": lambda r: r._replace(scales=1e-20 * r.scales),
    "scales 1e+20": lambda r: r._replace(scales=1e20 * r.scales),
    "scales 1e-20 to 1e20": lambda r: r._replace(scales=10.0 ** np.linspace(-20, 20, 48).reshape(16, 3)),
    "all scales equal": lambda r: r._replace(scales=np.full((16, 3), 0.3)),
    "all scales 0": lambda r: r._replace(scales=0 * r.scales),
    "all alike and coincident": lambda r: upright(0 * r.means),
    "along the axis": lambda r: r._replace(means=r.means * [0, 0, 1]),
    "units 1e-20": lambda r: r._replace(means=1e-20 * r.means, scales=1e-20 * r.scales),
    "units 1e+20": lambda r: r._replace(means=1e20 * r.means, scales=1e20 * r.scales),
}


@case("as printed, {name}", name=PRINTED)
def printed_metric(name: str) -> Outcome:
    region = PRINTED[name](cloud())
    return compare(region, aspect(region.scales), metric="printed", axis="world")


# graphs that fall apart


@case("32 far pairs")
def far_pairs() -> Outcome:
    means = np.repeat(np.random.default_rng(0).normal(size=(32, 3)) * 1e4, 2, 0)
    means[1::2] += np.random.default_rng(1).normal(size=(32, 3)) * 0.3
    region = cloud(64)._replace(means=means)
    outcome = compare(region, "32 zero modes")
    return outcome._replace(naive=as_printed(region, n_eigs=8))


@case("two far clusters")
def far_clusters() -> Outcome:
    region = cloud(20)
    region = region._replace(means=region.means + 1e3 * (np.arange(20) % 2)[:, None])
    # The axis is parted from the next one by 1e-7 of the variance, so float64 knows it to 1e-9 only.
    return compare(region, "weights between 0", tolerance_64=1e-9)


@case("an edge of 1e-200")
def faint_edge() -> Outcome:
    region = Region(np.array([[-1.0, 0, 0], [1.0, 0, 0]]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    bandwidth = float(2 / np.sqrt(np.log(1e200)))
    outcome = compare(region, "weight 1e-200", bandwidth=bandwidth)
    return outcome._replace(naive=as_printed(region, n_eigs=1, bandwidth=bandwidth))


@case("one outlier at {distance:.0e}", distance=[1e4, 1e8])
def outlier(distance: float) -> Outcome:
    region = cloud()
    region.means[-1] = distance
    return compare(region, f"distance {distance:.0e}")


# units and places


@case("units {units:.0e}", units=[1e-150, 1e-30, 1e30, 1e150])
def units(units: float) -> Outcome:
    region = cloud()
    return compare(region._replace(means=region.means * units, scales=region.scales * units), f"unit {units:.0e}")


@case("offset {offset:.0e}", offset=[1e6, 1e9])
def offset(offset: float) -> Outcome:
    region = cloud()
    return compare(region._replace(means=region.means + offset), f"offset/size {offset:.0e}")


# symmetric regions: eigenspaces of many dimensions

SYMMETRIC: dict[str, Callable[[], Region]] = {
    "coincident": lambda: cloud()._replace(means=np.full((16, 3), 0.3)),
    "coincident and round": lambda: upright(np.full((16, 3), 0.3)),
    "half of them coincident": lambda: cloud()._replace(means=np.repeat(cloud(8).means, 2, 0)),
    "collinear": lambda: cloud()._replace(means=cloud().means * [1, 0, 0]),
    "collinear and round": lambda: upright(lattice(16, 1, 1)),
    "coplanar": lambda: cloud()._replace(means=cloud().means * [1, 1, 0]),
    "square lattice": lambda: upright(lattice(5, 5, 1)),
    "square lattice of pancakes": lambda: upright(lattice(5, 5, 1))._replace(scales=np.tile([0.4, 0.4, 0.01], (25, 1))),
    "cubic lattice": lambda: upright(lattice(3, 3, 3)),
    "ring": lambda: upright(np.stack([f(np.arange(16) * np.pi / 8) for f in (np.cos, np.sin, np.zeros_like)], -1)),
}  # fmt: skip


@case("{name}, permuted", name=SYMMETRIC)
def symmetric(name: str) -> Outcome:
    region = SYMMETRIC[name]()
    spread = np.linalg.svd(region.means - region.means.mean(0), compute_uv=False)
    return compare(region, f"spread {spread[0]:.1f} {spread[1]:.1f} {spread[2]:.1f}")


# settings


@case("sigma {bandwidth:.0e}", bandwidth=[1e-6, 1e-4, 1e-2, 1e2, 1e6])
def bandwidths(bandwidth: float) -> Outcome:
    return compare(cloud(), f"sigma/rms {bandwidth:.0e}", bandwidth=bandwidth)


@case("a {anisotropy:.0e}", anisotropy=[0.0, 1e-12, 1e6, 1e12])
def anisotropies(anisotropy: float) -> Outcome:
    return compare(cloud(), f"a {anisotropy:.0e}", anisotropy=anisotropy)


@case("sigma {bandwidth:.0e}, a {anisotropy:.0e}, needles", bandwidth=[1e-6, 1e6], anisotropy=[1e-12, 1e12])
def both(bandwidth: float, anisotropy: float) -> Outcome:
    region = cloud()
    region = region._replace(scales=region.scales * [1e6, 1, 1])
    return compare(region, aspect(region.scales), bandwidth=bandwidth, anisotropy=anisotropy)


# few, broken, and padded


@case("n = {n}, padded to 64", n=[0, 1, 2, 3, 16])
def padded(n: int) -> Outcome:
    region = cloud(n)
    outcome = compare(region, f"{64 - n} rows padded", pad=64 - n)
    bare = relative(ours(region), ours(region, pad=64 - n)) if n else 0.0
    return outcome._replace(error=max(outcome.error, bare), naive=as_printed(region))


@case("one {bad} in the {field}", bad=[np.nan, np.inf], field=Region._fields)
def one_broken(bad: float, field: str) -> Outcome:
    """The row is zero, its neighbours are as if it were not there, and the region beside it keeps every bit."""
    clean, other, rest = cloud(), cloud(seed=1), np.delete(np.arange(16), 5)
    broken = Region(*(v.copy() for v in clean))
    getattr(broken, field)[5].flat[1] = bad
    both = [torch.from_numpy(np.stack(v)) for v in zip(broken, other, strict=True)]
    found = describe(*both, torch.ones(2, 16, dtype=torch.bool)).values.double().numpy()
    if (found[0, 5] != 0).any() or not np.array_equal(found[1], ours(other)):
        raise ValueError("the broken row is not zero, or the region beside it has changed")
    error = relative(found[0, rest], oracle.describe(*(v[rest] for v in clean)))
    return Outcome("1 of 16 Gaussians", as_printed(broken), error, TOLERANCE)


@case("every Gaussian NaN")
def all_broken() -> Outcome:
    region = cloud()
    broken = region._replace(means=region.means * np.nan)
    found = ours(broken)
    return Outcome("16 of 16 Gaussians", as_printed(broken), relative(found, np.zeros_like(found)), 0.0)


# gradients

FLAT: dict[str, Callable[[], Region]] = {
    "square lattice": SYMMETRIC["square lattice"],
    "cubic lattice": SYMMETRIC["cubic lattice"],
    "coincident points": SYMMETRIC["coincident and round"],
}


@case("gradient on {name}", name=FLAT)
def gradient(name: str) -> Outcome:
    """Share of gradient entries that are not finite, 0 without a path for gradients; the naive go by eigenvectors."""
    region = FLAT[name]()
    values = [torch.from_numpy(v)[None] for v in region]
    means = values[0].requires_grad_(True)
    found = describe(means, *values[1:], torch.ones(1, len(region.means), dtype=torch.bool)).values
    bad = 0.0
    if found.requires_grad:
        (slope,) = torch.autograd.grad(found.square().sum(), means)
        bad = 1 - torch.isfinite(slope).double().mean().item()

    def attempt() -> str:
        centers = torch.from_numpy(region.means).float().requires_grad_(True)
        square = (centers[:, None] - centers[None]).square().sum(-1)
        weights = torch.exp(-square / 0.7**2) * (1 - torch.eye(len(centers)))
        laplacian = torch.eye(len(centers)) - weights / weights.sum(1, keepdim=True)
        vectors = torch.linalg.eig(laplacian).eigenvectors[:, :16].abs()
        (slope,) = torch.autograd.grad((vectors**2).sum(1).square().sum(), centers)
        return f"{100 * (1 - torch.isfinite(slope).double().mean().item()):.0f} % NaN"

    path = "through ours" if found.requires_grad else "no path in ours"
    return Outcome(path, naive(attempt), bad, 0.0)
