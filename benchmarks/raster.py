"""Speed of the CPU rasterizer: ratios beside their bars, steps and kernels in milliseconds.

A step is forward, L1 and backward. Variants take turns, round by round, and the fastest round of
each counts: other load on the machine only ever adds.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.kernels.threads import set_n_threads
from chebsplat.rasterize import binning, ellipses, rasterize, tiles, tiles_adjoint
from chebsplat.training.losses import feature_distance, photometric

SIZE, N, CHANNELS = (320, 240), 20_000, 19
Action = Callable[[], object]


def scene(n: int, channels: int) -> list[torch.Tensor]:
    """Gaussians through a room before the camera, about as large as their spacing."""
    g = torch.Generator().manual_seed(0)
    room = torch.tensor([5.0, 3.5, 4.0]), torch.tensor([-2.5, -1.75, 0.8])
    means = torch.rand(n, 3, generator=g) * room[0] + room[1]
    scales = (70 / n) ** (1 / 3) * 0.3 * (0.4 + torch.rand(n, 3, generator=g))
    values = [
        means,
        torch.randn(n, 4, generator=g),
        scales,
        torch.rand(n, generator=g) * 0.9 + 0.05,
    ]
    return [v.requires_grad_(True) for v in [*values, torch.rand(n, channels, generator=g)]]


def camera(
    width: int = SIZE[0], height: int = SIZE[1]
) -> tuple[torch.Tensor, torch.Tensor, int, int]:
    K = torch.tensor([[[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]]])
    return torch.eye(4)[None], K, width, height


def step(backend: str, n: int = N, channels: int = CHANNELS) -> Action:
    """Forward, L1 and backward."""
    device = "cuda" if backend == "cuda" else "cpu"
    arguments = [a.detach().to(device).requires_grad_(True) for a in scene(n, channels)]
    viewmats, K, width, height = camera()
    target = torch.rand(1, height, width, channels, device=device)

    def run() -> None:
        for a in arguments:
            a.grad = None
        view = viewmats.to(device), K.to(device), width, height
        render, _, _ = rasterize(*arguments, *view, backend=backend, max_alpha=0.999)
        torch.nn.functional.l1_loss(render, target).backward()
        if device == "cuda":
            torch.cuda.synchronize()

    return run


def training_step(features: int, *, by_cell: bool) -> Action:
    """A training's step: three colours, `features` at a quarter of the size, both losses."""
    arguments, (width, height) = scene(N, 3 + features), SIZE
    color, target = torch.rand(height, width, 3), torch.rand(height // 4, width // 4, features)

    def run() -> None:
        for a in arguments:
            a.grad = None
        *gaussians, channels = arguments
        if features and by_cell:
            parts = [part.contiguous() for part in channels.split([3, features], -1)]
            render, _, meta = rasterize(
                *gaussians, parts[0], *camera(), backend="cpu", cell_colors=parts[1]
            )
            image, rendered = render[0], meta["cells"][0]
        else:
            render = rasterize(*gaussians, channels, *camera(), backend="cpu")[0][0]
            image, rendered = render.split([3, features], -1)
        loss = photometric(image, color, None, 0.2)
        (loss + feature_distance(rendered, target) if features else loss).backward()

    return run


def stages() -> dict[str, Action]:
    """The numba stages by themselves, without torch; `forward` and `backward` are the kernels."""
    means, quats, scales, opacities, colors = (t.detach().numpy() for t in scene(N, CHANNELS))
    viewmats, Ks, width, height = camera()
    view, ceiling = (
        (viewmats[0].double().numpy(), Ks[0].double().numpy(), width, height),
        np.float32(0.999),
    )
    gaussians, by_channel = (means, quats, scales), (opacities, colors, colors[:, :0])
    no_slope, no_cells = np.zeros(N, np.float32), np.zeros((height // 4, width // 4, 0), np.float32)
    rng = np.random.default_rng(0)
    grad = (
        rng.random((height, width, CHANNELS), np.float32),
        no_cells,
        rng.random((height, width), np.float32),
    )
    means2d, covariances, whitening, _, depths, radii, _ = ellipses.project(
        *gaussians, *view, 0.01, 1e10, 0.3
    )

    def bins() -> binning.Bins:
        return binning.bin_gaussians(
            means2d, covariances, depths, radii, *by_channel, width, height
        )

    binned = bins()

    def pack() -> np.ndarray:
        return tiles.pack(binned.order, means2d, whitening, *by_channel)

    splats = pack()

    def forward() -> tuple[np.ndarray, ...]:
        return tiles.forward(
            splats, binned.tile_starts, binned.rank, CHANNELS, 0, width, height, ceiling
        )

    _, _, _, *masks_and_used = forward()

    def backward() -> tuple[Any, ...]:
        return tiles_adjoint.backward(N, splats, *binned, *masks_and_used, ceiling, *grad, False)

    to_means2d, moments, *_ = backward()
    return {
        "project": lambda: ellipses.project(*gaussians, *view, 0.01, 1e10, 0.3),
        "bin": bins,
        "pack": pack,
        "forward": forward,
        "backward": backward,
        "project back": lambda: ellipses.project_adjoint(
            *gaussians, *view, 0.3, radii, to_means2d, moments, no_slope
        ),
    }


def take_turns(variants: dict[str, tuple[int, Action]], rounds: int) -> dict[str, float]:
    """Milliseconds of the fastest of `rounds` by name; variants are (threads, action). Each turn
    begins with a run that does not count: it fills the caches, and starts as many threads.
    """
    best = dict.fromkeys(variants, np.inf)
    for _ in range(rounds):
        for name, (n, action) in variants.items():
            torch.set_num_threads(n)
            set_n_threads(n)
            action()
            began = time.perf_counter()
            action()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - began))
    return best


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("raster", __doc__)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument(
        "--yardstick",
        default=os.environ.get("YARDSTICK"),
        type=Path,
        metavar="FOLDER",
        help="of yardstick.py, to run beside ours (default: $YARDSTICK)",
    )
    options = parser.parse_args(arguments)
    if options.yardstick:
        for n in (1, 2):
            command = [
                sys.executable,
                "-P",
                str(options.yardstick / "yardstick.py"),
                "--beside",
                "chebsplat",
            ]
            subprocess.run(
                [*command, "--threads", str(n), "--rounds", str(options.rounds)], check=True
            )
    cpu = step("cpu")
    variants: dict[str, tuple[int, Action]] = {
        "torch, 4 threads": (4, step("reference")),
        "cpu, 1 thread": (1, cpu), "cpu, 2 threads": (2, cpu), "cpu, 4 threads": (4, cpu),
        "cpu, 3 channels": (4, step("cpu", channels=3)), "cpu, 100k": (4, step("cpu", n=100_000)),
        "training step, 3 colors": (4, training_step(0, by_cell=False)),
        "training step, 32 features by pixel": (4, training_step(32, by_cell=False)),
        "training step, 32 features by cell": (4, training_step(32, by_cell=True)),
    }  # fmt: skip
    for name, action in stages().items():
        variants |= {f"{name}, {n} thread{'s'[: n > 1]}": (n, action) for n in (1, 4)}
    if torch.cuda.is_available() and importlib.util.find_spec("gsplat"):
        variants["cuda"] = (4, step("cuda"))
    times = take_turns(variants, options.rounds)
    base, colors = times["cpu, 4 threads"], times["training step, 3 colors"]
    bars: list[shared.Bar] = [
        ("torch over cpu, four threads", times["torch, 4 threads"] / base, ">=", 20),
        ("19 channels over 3", base / times["cpu, 3 channels"], "<=", 2.0),
        ("100k Gaussians over 20k", times["cpu, 100k"] / base, "<=", 1.9),
        (
            "32 features by cell over none",
            times["training step, 32 features by cell"] / colors,
            "<=",
            1.5,
        ),
    ]
    if shared.cores() >= 4:
        bars.append(("one thread over four", times["cpu, 1 thread"] / base, ">=", 2.5))
    else:
        print(f"one thread over four: not asked on {shared.cores()} cores")
    print(shared.machine())
    print(
        f"{N} Gaussians, {SIZE[0]}x{SIZE[1]}, {CHANNELS} channels; fastest of {options.rounds} "
        "rounds"
    )
    rows: list[dict[str, Any]] = []
    for name, ms in times.items():
        print(f"  {name:<36} {ms:9.2f} ms")
        rows.append({"what": name, "value": ms, "unit": "ms"})
    met = shared.judged(bars)
    for (what, value, relation, bar), within in zip(bars, met, strict=True):
        bounds = {"bar": f"{relation} {bar:g}", "within": within}
        rows.append({"what": what, "value": value, "unit": "ratio", **bounds})
    shared.write_csv(options.out / "rasterize.csv", rows)
    return int(not all(met))
