"""Milliseconds of the rasterizer, its stages and the fused loss, by image size, Gaussians and channels.

Usage: python benchmarks/rasterize.py [--csv FILE] [--reference]
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import time
from collections.abc import Callable

import chebsplat  # isort: skip  # before torch: a busy machine punishes OpenMP threads that wait actively
import numba
import numpy as np
import torch

from chebsplat.losses import photometric, photometric_reference
from chebsplat.rasterize import binning, ellipses, rasterize, tiles

CASES = [(320, 240, 5_000, 19), (320, 240, 20_000, 3), (320, 240, 20_000, 16), (320, 240, 20_000, 19),
         (320, 240, 100_000, 19), (640, 480, 20_000, 19), (640, 480, 100_000, 19)]  # fmt: skip


def median_ms(action: Callable[[], object], repeats: int) -> float:
    action()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return 1e3 * sorted(times)[len(times) // 2]


def scene(n: int, channels: int) -> list[torch.Tensor]:
    """Gaussians through a room before the camera, about as large as their spacing."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g) * torch.tensor([5.0, 3.5, 4.0]) + torch.tensor([-2.5, -1.75, 0.8])
    scales = (70 / n) ** (1 / 3) * 0.3 * (0.4 + torch.rand(n, 3, generator=g))
    values = [means, torch.randn(n, 4, generator=g), scales, torch.rand(n, generator=g) * 0.9 + 0.05]
    return [v.requires_grad_(True) for v in [*values, torch.rand(n, channels, generator=g)]]


def measure(width: int, height: int, n: int, channels: int, backend: str, repeats: int) -> dict[str, float]:
    arguments = scene(n, channels)
    K = torch.tensor([[[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]]])
    camera = (torch.eye(4)[None], K, width, height)
    weights = torch.rand(1, height, width, channels)

    def forward() -> torch.Tensor:
        return rasterize(*arguments, *camera, backend=backend)[0]

    with torch.no_grad():
        render_only = median_ms(forward, repeats)
    both = median_ms(lambda: (forward() * weights).sum().backward(), repeats)
    return {"forward": render_only, "forward+backward": both}


def measure_stages(width: int, height: int, n: int, channels: int, repeats: int) -> dict[str, float]:
    """The numba stages by themselves, without torch."""
    means, quats, scales, opacities, colors = (t.detach().numpy() for t in scene(n, channels))
    K = np.array([[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1.0]])
    camera, size, ceiling = (np.eye(4), K, width, height), (width, height), np.float32(0.99)
    gaussians, by_channel = (means, quats, scales), (opacities, colors)
    rng = np.random.default_rng(0)
    no_slope = np.zeros(n, np.float32)
    grad = rng.random((height, width, channels), np.float32), rng.random((height, width), np.float32)

    def project() -> tuple[np.ndarray, ...]:
        return ellipses.project(*gaussians, *camera, 0.01, 1e10, 0.3)

    means2d, covariances, whitening, _, depths, radii, _ = project()

    def bins() -> tuple[np.ndarray, ...]:
        return binning.bin_gaussians(means2d, covariances, depths, radii, *by_channel, *size)

    pairs = bins()

    def forward() -> object:
        return tiles.forward(means2d, whitening, *by_channel, *pairs[:2], *size, ceiling)

    def backward() -> tuple[np.ndarray, bool]:
        return tiles.backward(means2d, whitening, *by_channel, *pairs[:3], *size, ceiling, *grad)

    records, _ = backward()

    def reduce() -> object:
        to_means2d, moments, *_ = tiles.reduce(records, pairs[3], whitening, opacities)
        return ellipses.project_adjoint(*gaussians, *camera, 0.3, radii, to_means2d, moments, no_slope)

    stages = {"project": project, "bin": bins, "tiles": forward, "tiles, adjoint": backward, "reduce, project": reduce}
    return {f"stage: {name}": median_ms(stage, repeats) for name, stage in stages.items()}


def measure_loss(width: int, height: int, repeats: int) -> dict[str, float]:
    a, b = torch.rand(height, width, 3, requires_grad=True), torch.rand(height, width, 3)
    fused = median_ms(lambda: photometric(a, b, None, 0.2).backward(), repeats)
    plain = median_ms(lambda: photometric_reference(a, b, None, 0.2).backward(), repeats)
    return {"fused loss": fused, "torch loss": plain}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--csv")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--reference", action="store_true", help="the torch oracle too, at the smallest size")
    options = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores; median of {options.repeats}")
    print(f"chebsplat {chebsplat.__version__}, OpenMP waits {os.environ.get('OMP_WAIT_POLICY')}")
    print(f"numba {numba.__version__} on {numba.get_num_threads()} threads")
    print(f"torch {torch.__version__} on {torch.get_num_threads()} threads")
    rows = []
    for case in CASES:
        for backend in ("cpu", "reference") if options.reference and case == CASES[0] else ("cpu",):
            figures = measure(*case, backend, options.repeats)
            base = {"size": f"{case[0]}x{case[1]}", "n": case[2], "channels": case[3]}
            rows += [base | {"what": f"{backend} {k}", "ms": v} for k, v in figures.items()]
            if backend == "cpu":
                stages = measure_stages(*case, options.repeats)
                rows += [base | {"what": k, "ms": v} for k, v in stages.items()]
    for width, height in ((320, 240), (640, 480)):
        figures = measure_loss(width, height, options.repeats)
        rows += [{"size": f"{width}x{height}", "n": "", "channels": 3, "what": k, "ms": v} for k, v in figures.items()]
    for row in rows:
        print(f"{row['size']:>8} {row['n']!s:>7} {row['channels']:>3}  {row['what']:<26} {row['ms']:8.2f} ms")
    if options.csv:
        with open(options.csv, "w", newline="") as handle:
            writer = csv.DictWriter(handle, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
