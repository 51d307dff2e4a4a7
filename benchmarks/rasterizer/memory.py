"""Memory of one differentiated render, and of ten thousand, in a process of its own (Linux).

The kernel keeps the peak of the resident set; writing 5 to /proc/self/clear_refs starts it anew. `peak` is how far one
forward and backward pass raises it over what was resident before, after a warm-up on a scene a hundredth the size, so
that neither compilation nor thread stacks count. `drift` is what is resident after 10,000 iterations over after 1,000.

Usage: python benchmarks/rasterizer/memory.py peak GAUSSIANS CHANNELS | drift  (prints JSON)
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import chebsplat  # isort: skip  # noqa: F401  # before torch, which then waits passively
import torch

from chebsplat.rasterize import rasterize, reference
from chebsplat.rasterize.projection import project

SIZE = (320, 240)


def scene(n: int, channels: int) -> list[torch.Tensor]:
    """Gaussians through a room before the camera, about as large as their spacing."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g) * torch.tensor([5.0, 3.5, 4.0]) + torch.tensor([-2.5, -1.75, 0.8])
    scales = (70 / n) ** (1 / 3) * 0.3 * (0.4 + torch.rand(n, 3, generator=g))
    values = [means, torch.randn(n, 4, generator=g), scales, torch.rand(n, generator=g) * 0.9 + 0.05]
    return [v.requires_grad_(True) for v in [*values, torch.rand(n, channels, generator=g)]]


def camera(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor, int, int]:
    K = torch.tensor([[[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]]])
    return torch.eye(4)[None], K, width, height


def count_pairs(arguments: list[torch.Tensor], width: int, height: int) -> int:
    """Pairs of a Gaussian and a tile of 16×16 pixels that its ellipse α ≥ 1/255 reaches."""
    means, quats, scales, opacities, _ = (a.detach() for a in arguments)
    viewmats, Ks, _, _ = camera(width, height)
    view = project(means, quats, scales, viewmats[0], Ks[0], width, height, 0.01, 1e10, 0.3)
    shown = view.visible & (opacities >= reference.ALPHA_MIN)
    table = torch.cat([view.means2d, view.whitening, opacities[:, None]], 1)[shown]
    columns, rows = -(-width // 16), -(-height // 16)
    return len(reference._pairs(table, view.covariances[shown], columns, rows, width, height, 16)[0])


def resident(which: str) -> int:
    """Bytes: VmRSS now, or VmHWM at the peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(which):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {which}")


def iterate(arguments: list[torch.Tensor], width: int, height: int, grads: tuple[torch.Tensor, torch.Tensor]) -> None:
    render, alpha, _ = rasterize(*arguments, *camera(width, height), backend="cpu")
    torch.autograd.backward([render, alpha], list(grads))


def peak(n: int, channels: int) -> dict[str, int]:
    width, height = SIZE
    grads = torch.rand(1, height, width, channels), torch.rand(1, height, width, 1)
    small = scene(n // 100, channels)
    for _ in range(3):
        iterate(small, width, height, grads)
    arguments = scene(n, channels)
    pairs = count_pairs(arguments, width, height)
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    iterate(arguments, width, height, grads)
    growth = resident("VmHWM") - before
    images = 2 * 4 * width * height * (channels + 1)  # render and alpha, and what comes back for them
    return {"n": n, "channels": channels, "pairs": pairs, "images": images, "growth": growth}


def drift(iterations: int = 10_000) -> dict[str, int]:
    arguments = scene(50, 3)
    grads = torch.rand(1, 16, 16, 3), torch.rand(1, 16, 16, 1)
    after = {}
    for k in range(1, iterations + 1):
        iterate(arguments, 16, 16, grads)
        if k in (iterations // 10, iterations):
            after[k] = resident("VmRSS")
    return {"iterations": iterations, "growth": after[iterations] - after[iterations // 10]}


def measured(*arguments: object) -> dict[str, int]:
    """What this file prints with these arguments, in a process of its own."""
    command = [sys.executable, __file__, *map(str, arguments)]
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536"}
    return json.loads(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)


if __name__ == "__main__":
    print(json.dumps(drift() if sys.argv[1] == "drift" else peak(*map(int, sys.argv[2:]))))
