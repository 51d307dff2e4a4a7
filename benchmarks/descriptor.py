"""The compiled descriptor: regions a second, errors against 60 digits, growth of sampling.

Regions are flat clouds and pieces of a generated office; errors are relative to a region's largest
value.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from benchmarks import shared
from benchmarks.stability import oracle
from chebsplat.kernels.threads import n_threads, set_n_threads
from chebsplat.settings import DescribeSection
from chebsplat.shape.described import Descriptor
from chebsplat.shape.descriptor import describe
from chebsplat.shape.regions import regions_of
from chebsplat.splats.gaussians import activated, initial_gaussians, local_shape
from chebsplat.splats.rotations import rotation_matrices
from chebsplat.synthetic import layout

N, SETTINGS = 64, {"n_angles": 4, "max_degree": 8, "anisotropy": 30.0, "bandwidth": 0.7}
ERROR = 5e-6  # bar, at worst
# means, scales [M, n, 3], rotmats [M, n, 3, 3]
Regions = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def clouds(m: int, n: int) -> Regions:
    """Flat clouds of flat Gaussians."""
    g = torch.Generator().manual_seed(0)
    means = torch.randn(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.2])
    scales = torch.rand(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.2, 0.02])
    return (
        means,
        scales + 0.01,
        rotation_matrices(torch.randn(m, n, 4, generator=g, dtype=torch.float64)),
    )


def room(m: int, n: int) -> Regions:
    """Regions of Gaussians on the surfaces of a generated office, 5 mm off."""
    soup, rng = layout.build("office", 0).soup, np.random.default_rng(0)
    corners = soup.vertices[soup.triangles].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    corners = corners[rng.choice(len(area), 20_000, p=area / area.sum())]
    points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), len(corners)), corners)
    points += 0.005 * rng.standard_normal(points.shape)
    raw = initial_gaussians(
        points, np.full(points.shape, 128, np.uint8), local_shape(points, 16)[0]
    )
    _, quats, scales, _ = activated(raw)
    members = torch.as_tensor(
        regions_of(points, DescribeSection(n_regions=4 * m, region_size=n)).members
    )
    members = members[(members >= 0).all(1)][:m]
    return (
        torch.as_tensor(points)[members],
        scales[members].double(),
        rotation_matrices(quats[members]).double(),
    )


def described(regions: Regions) -> torch.Tensor:
    mask = torch.ones(regions[0].shape[:2], dtype=torch.bool)
    parameters = Descriptor(**SETTINGS)  # type: ignore[arg-type]
    return describe(*regions, mask, parameters, backend="numba").values


def error(regions: Regions) -> float:
    """Of the worst region."""
    ours, worst = described(regions).double().numpy(), 0.0
    for values, *region in zip(ours, *(part.numpy() for part in regions), strict=True):
        exact = oracle.describe(*region, **SETTINGS)  # type: ignore[arg-type]
        worst = max(worst, float(np.abs(values - exact).max() / np.abs(exact).max()))
    return worst


def best(action: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest call, after one that warms up."""
    action()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return min(times)


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("descriptor", __doc__)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args(arguments)
    print(shared.machine())
    errors = {"clouds": error(clouds(2, 32)), "room": error(room(2, 32))}
    regions, rows = clouds(2048, N), []
    for threads in [n for n in (1, 2, 4) if n <= n_threads()]:
        set_n_threads(threads)
        rate = len(regions[0]) / best(lambda: described(regions), options.repeats)
        rows.append({"what": f"regions a second, {threads} threads", "value": rate})
    torch.set_num_threads(1)
    matrices = torch.rand(96 * 4, N, N)  # four angles a region
    rate = 96 / best(lambda: torch.linalg.eigh(matrices + matrices.mT), options.repeats)
    rows.append({"what": "of batched eigh in float32 alone, 1 thread", "value": rate})
    for n in (10_000, 100_000, 1_000_000):
        points = np.random.default_rng(0).random((n, 3)) * [5.0, 4.0, 0.3]
        seconds = best(
            lambda points=points: regions_of(
                points, DescribeSection(n_regions=2048, region_size=N)
            ),
            2,
        )  # type: ignore[misc]
        rows.append(
            {"what": f"milliseconds of sampling 2048 regions of {n} points", "value": 1e3 * seconds}
        )
    for row in rows:
        print("{what:<52} {value:10.3g}".format(**row))
    rows += [{"what": f"largest error, {name}", "value": value} for name, value in errors.items()]
    shared.write_csv(options.out / "descriptor.csv", rows)
    bars = [(f"largest error, {name}", value, "<=", ERROR) for name, value in errors.items()]
    return int(not all(shared.judged(bars)))
