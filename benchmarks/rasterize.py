"""Every bar of the CPU rasterizer in one run, as a ratio beside its bar; a CSV and a work-precision figure.

A step is forward, L1 and backward. Variants take turns, round by round, and the fastest round of each counts: other
load on the machine only ever adds. Errors are against float64, under a loss linear in the image, without the pixels
where rounding moves an alpha across 1/255 or a transmittance across the stop (the float64 image changes if those
limits move by 1e-5).

Usage: python benchmarks/rasterize.py [--out build/bench] [--rounds 15]
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import chebsplat  # isort: skip  # before torch: a busy machine punishes OpenMP threads that wait actively
import numba
import numpy as np
import torch
from raster_memory import camera, measured, scene

from chebsplat.rasterize import binning, ellipses, rasterize, reference, tiles
from chebsplat.training.losses import feature_distance, photometric

SIZE, N, CHANNELS = (320, 240), 20_000, 19
THREADS = 4
Timed = dict[str, float]  # milliseconds by name


def threads(n: int) -> None:
    torch.set_num_threads(n)
    numba.set_num_threads(min(n, numba.config.NUMBA_NUM_THREADS))


def take_turns(variants: dict[str, tuple[int, Callable[[], object]]], rounds: int) -> Timed:
    """Fastest of `rounds` by name; variants are (threads, action). Each turn begins with a run that does not count:
    it fills the caches, and starts as many threads."""
    best = dict.fromkeys(variants, np.inf)
    for _ in range(rounds):
        for name, (n, action) in variants.items():
            threads(n)
            action()
            began = time.perf_counter()
            action()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - began))
    return best


def step(backend: str, n: int = N, channels: int = CHANNELS, dtype: torch.dtype = torch.float32) -> Callable[[], None]:
    """Forward, L1 and backward."""
    device = "cuda" if backend == "cuda" else "cpu"
    arguments = [a.detach().to(device, dtype).requires_grad_(True) for a in scene(n, channels)]
    viewmats, K, width, height = camera(*SIZE)
    target = torch.rand(1, height, width, channels, dtype=dtype, device=device)

    def run() -> None:
        for a in arguments:
            a.grad = None
        render, _, _ = rasterize(
            *arguments, viewmats.to(target), K.to(target), width, height, backend=backend, max_alpha=0.999
        )
        torch.nn.functional.l1_loss(render, target).backward()
        if device == "cuda":
            torch.cuda.synchronize()

    return run


def training_step(features: int, *, by_cell: bool) -> Callable[[], None]:
    """A training's step: three colours and `features` of a teacher at a quarter of the image's size, both losses."""
    arguments, (width, height) = [a.requires_grad_(True) for a in scene(N, 3 + features)], SIZE
    color, target = torch.rand(height, width, 3), torch.rand(height // 4, width // 4, features)

    def run() -> None:
        for a in arguments:
            a.grad = None
        *gaussians, channels = arguments
        if features and by_cell:
            parts = [part.contiguous() for part in channels.split([3, features], -1)]
            render, _, meta = rasterize(*gaussians, parts[0], *camera(*SIZE), backend="cpu", cell_colors=parts[1])
            image, rendered = render[0], meta["cells"][0]
        else:
            render = rasterize(*gaussians, channels, *camera(*SIZE), backend="cpu")[0][0]
            image, rendered = render.split([3, features], -1)
        loss = photometric(image, color, None, 0.2)
        (loss + feature_distance(rendered, target) if features else loss).backward()

    return run


def stages() -> dict[str, Callable[[], object]]:
    """The numba stages by themselves, without torch; `forward` and `backward` are the kernels."""
    means, quats, scales, opacities, colors = (t.detach().numpy() for t in scene(N, CHANNELS))
    viewmats, Ks, width, height = camera(*SIZE)
    view, ceiling = (viewmats[0].double().numpy(), Ks[0].double().numpy(), width, height), np.float32(0.999)
    gaussians, by_channel = (means, quats, scales), (opacities, colors, colors[:, :0])
    no_slope, no_cells = np.zeros(N, np.float32), np.zeros((height // 4, width // 4, 0), np.float32)
    rng = np.random.default_rng(0)
    grad = rng.random((height, width, CHANNELS), np.float32), no_cells, rng.random((height, width), np.float32)
    means2d, covariances, whitening, _, depths, radii, _ = ellipses.project(*gaussians, *view, 0.01, 1e10, 0.3)

    def bins() -> binning.Bins:
        return binning.bin_gaussians(means2d, covariances, depths, radii, *by_channel, width, height)

    found = bins()

    def pack() -> np.ndarray:
        return tiles.pack(found.order, means2d, whitening, *by_channel)

    splats = pack()

    def forward() -> tuple[np.ndarray, ...]:
        return tiles.forward(splats, found.tile_starts, found.rank, CHANNELS, 0, width, height, ceiling)

    _, _, _, *seen = forward()

    def backward() -> tuple[Any, ...]:
        return tiles.backward(N, splats, *found, *seen, ceiling, *grad, False)

    to_means2d, moments, *_ = backward()
    return {
        "project": lambda: ellipses.project(*gaussians, *view, 0.01, 1e10, 0.3),
        "bin": bins,
        "pack": pack,
        "forward": forward,
        "backward": backward,
        "project back": lambda: ellipses.project_adjoint(*gaussians, *view, 0.3, radii, to_means2d, moments, no_slope),
    }


def loss() -> Callable[[], None]:
    """The training's loss of 3 channels of colour and the rest features, value and gradient."""
    width, height = SIZE
    image, target = torch.rand(height, width, CHANNELS, requires_grad=True), torch.rand(height, width, CHANNELS)

    def run() -> None:
        image.grad = None
        (color, features), (wanted_color, wanted) = (v.split([3, CHANNELS - 3], -1) for v in (image, target))
        (photometric(color, wanted_color, None, 0.2) + feature_distance(features, wanted)).backward()

    return run


def render_and_back() -> Callable[[], None]:
    """Forward and backward without any loss."""
    arguments, view = scene(N, CHANNELS), camera(*SIZE)
    grad = torch.rand(1, SIZE[1], SIZE[0], CHANNELS)

    def run() -> None:
        for a in arguments:
            a.grad = None
        rasterize(*arguments, *view, backend="cpu")[0].backward(grad)

    return run


@numba.njit(fastmath={"contract"}, inline="always")
def _sixteen(t: float, a: float, b: float) -> float:
    t = (((t * a + b) * a + b) * a + b) * a + b
    t = (((t * a + b) * a + b) * a + b) * a + b
    t = (((t * a + b) * a + b) * a + b) * a + b
    return (((t * a + b) * a + b) * a + b) * a + b


@numba.njit(fastmath={"contract"}, error_model="numpy")
def _multiply_add(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, a: float, b: float, repeats: int) -> None:
    """Sixteen dependent multiply-adds on each value of four small arrays: the pipes are full, memory idle."""
    for _ in range(repeats):
        for i in range(len(x)):
            w[i], x[i] = _sixteen(w[i], a, b), _sixteen(x[i], a, b)
            y[i], z[i] = _sixteen(y[i], a, b), _sixteen(z[i], a, b)


def multiply_adds() -> tuple[int, Callable[[], None]]:
    """How many multiply-adds the action does, and the action."""
    n, repeats = 256, 2000
    arrays = [np.ones(n, np.float32) for _ in range(4)]
    return 4 * 16 * n * repeats, lambda: _multiply_add(*arrays, np.float32(0.9), np.float32(0.1), repeats)


def contributions() -> int:
    """Contributing pairs of a pixel and a Gaussian."""
    counts, weights = [], reference._weights

    def counted(log_alphas: torch.Tensor, max_alpha: float) -> torch.Tensor:
        found = weights(log_alphas, max_alpha)
        counts.append(int(found.count_nonzero()))
        return found

    with mock.patch.object(reference, "_weights", counted), torch.no_grad():
        rasterize(*scene(N, CHANNELS), *camera(*SIZE), backend="reference", max_alpha=0.999)
    return sum(counts)


def differentiated(backend: str, dtype: torch.dtype, weights: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
    device = "cuda" if backend == "cuda" else "cpu"
    arguments = [a.detach().to(device, dtype).requires_grad_(True) for a in scene(N, CHANNELS)]
    viewmats, K, width, height = camera(*SIZE)
    weights = weights.to(device, dtype)
    render = rasterize(
        *arguments, viewmats.to(weights), K.to(weights), width, height, backend=backend, max_alpha=0.999
    )[0]
    render.backward(weights)
    return render.detach().cpu(), [a.grad.cpu() for a in arguments if a.grad is not None]


def decided_pixels() -> torch.Tensor:
    """[1, H, W], by the float64 image under both limits a little lower and a little higher."""
    images = []
    for sign in (-1, 1):
        limits = {"ALPHA_MIN": reference.ALPHA_MIN * (1 + sign * 1e-5), "T_MIN": reference.T_MIN * (1 + sign * 1e-5)}
        with mock.patch.multiple(reference, **limits), torch.no_grad():
            doubled = [a.double() for a in (*scene(N, CHANNELS), *camera(*SIZE)[:2])]
            images.append(rasterize(*doubled, *SIZE, backend="reference", max_alpha=0.999)[0])
    return (images[0] - images[1]).abs().amax(-1) < 1e-12


def errors(backends: dict[str, tuple[str, torch.dtype]]) -> dict[str, dict[str, float]]:
    """Image (root mean square, largest) and gradient (relative, worst of five) errors by name."""
    threads(THREADS)
    decided = decided_pixels()
    weights = torch.randn(1, SIZE[1], SIZE[0], CHANNELS, generator=torch.Generator().manual_seed(1))
    weights[~decided] = 0
    exact, slopes = differentiated("reference", torch.float64, weights)
    found = {}
    for name, (backend, dtype) in backends.items():
        render, grads = differentiated(backend, dtype, weights)
        difference = (render - exact)[decided]
        relative = [float((a - b).norm() / b.norm()) for a, b in zip(grads, slopes, strict=True)]
        found[name] = {
            "image": float(difference.square().mean().sqrt()),
            "image at worst": float(difference.abs().max()),
            "gradient": max(relative),
            "left out": float((~decided).double().mean()),
        }
    return found


def equal_bits() -> bool:
    results = []
    weights = torch.rand(1, SIZE[1], SIZE[0], CHANNELS, generator=torch.Generator().manual_seed(2))
    for n in (1, 2, 4):
        threads(n)
        render, grads = differentiated("cpu", torch.float32, weights)
        results.append([render, *grads])
    return all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def draw(path: Path, points: dict[str, tuple[float, dict[str, float]]], oracle_ms: float) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharex=True, layout="constrained")
    ends = min(ms for ms, _ in points.values()) / 1.5, oracle_ms * 1.5
    for ax, kind, bar in zip(axes, ("image", "gradient"), (1e-6, 1e-4), strict=True):
        for k, (name, (ms, error)) in enumerate(points.items()):
            ax.plot(ms, error[kind], "os^Dv<>"[k % 7], ms=8, label=f"{name}: {ms:.1f} ms")
        ax.axhline(bar, color="grey", lw=0.8, ls=":")
        ax.annotate("bar", (0.01, bar), xycoords=("axes fraction", "data"), va="bottom", color="grey")
        ax.axvline(oracle_ms, color="grey", lw=0.8, ls="--")
        ax.annotate("float64 oracle", (oracle_ms, 0.5), xycoords=("data", "axes fraction"), rotation=90, ha="right",
                    va="center", color="grey")  # fmt: skip
        lowest = min(error[kind] for _, error in points.values())
        ax.set(
            xscale="log",
            yscale="log",
            xlabel="ms a step (forward, L1, backward)",
            xlim=ends,
            ylim=(lowest / 5, bar * 5),
        )
        ax.set_xticks([t for t in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if ends[0] < t < ends[1]], minor=False)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
        ax.set_ylabel({"image": "image error (rms)", "gradient": "gradient error (relative, worst of five)"}[kind])
    axes[0].legend(fontsize=8, frameon=False)
    figure.suptitle(f"{N:,} Gaussians, {SIZE[0]}×{SIZE[1]}, {CHANNELS} channels: error against float64 over time")
    figure.savefig(path, dpi=130)


def describe() -> list[str]:
    model = platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return [
        f"{model} ({numba.config.CPU_NAME or numba.core.cpu.ll.get_host_cpu_name()}), {os.cpu_count()} cores{load}",
        f"chebsplat {chebsplat.__version__}, numba {numba.__version__} ({numba.threading_layer()}, "
        f"OpenMP waits {os.environ.get('OMP_WAIT_POLICY')}), torch {torch.__version__}, Python "
        f"{platform.python_version()}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()

    cpu, single = step("cpu"), torch.float32
    n_multiply_adds, multiply = multiply_adds()
    variants: dict[str, tuple[int, Callable[[], object]]] = {
        "reference f32, 1 thread": (1, step("reference")), "reference f32, 4 threads": (4, step("reference")),
        "reference f64, 4 threads": (4, step("reference", dtype=torch.float64)),
        "cpu, 1 thread": (1, cpu), "cpu, 2 threads": (2, cpu), "cpu, 4 threads": (4, cpu),
        "cpu, 3 channels": (4, step("cpu", channels=3)), "cpu, 100k": (4, step("cpu", n=100_000)),
        "cpu, 5k": (4, step("cpu", n=5_000)), "cpu, no loss": (4, render_and_back()), "loss": (4, loss()),
        "multiply-adds": (1, multiply),
        "training step, 3 colors": (4, training_step(0, by_cell=False)),
        "training step, 32 features by pixel": (4, training_step(32, by_cell=False)),
        "training step, 32 features by cell": (4, training_step(32, by_cell=True)),
    }  # fmt: skip
    for name, action in stages().items():
        variants |= {f"{name}, {n} thread{'s'[: n > 1]}": (n, action) for n in (1, 4)}
    backends = {"cpu": ("cpu", single), "reference f32": ("reference", single)}
    if torch.cuda.is_available() and importlib.util.find_spec("gsplat"):
        variants["cuda"] = (4, step("cuda"))
        backends["cuda"] = ("cuda", single)
    times = take_turns(variants, options.rounds)
    found = errors(backends)
    memory = measured("peak", N, CHANNELS)

    rate = n_multiply_adds / times["multiply-adds"] * 1e3
    n_pairs = contributions()
    floor = n_pairs * (13 + CHANNELS + 25 + 2 * CHANNELS) / rate * 1e3
    kernels = times["forward, 1 thread"] + times["backward, 1 thread"]
    base = times["cpu, 4 threads"]
    bars: list[tuple[str, float, str, float]] = [
        ("torch tile-GEMM reference over cpu", times["reference f32, 4 threads"] / base, ">=", 20),
        ("kernels over the FMA floor, one thread", kernels / floor, "<=", 4.0),
        ("one thread over four", times["cpu, 1 thread"] / base, ">=", 2.5),
        ("19 channels over 3", base / times["cpu, 3 channels"], "<=", 2.0),
        ("a step with 32 features by cell over without", times["training step, 32 features by cell"]
         / times["training step, 3 colors"], "<=", 1.5),
        ("loss over rasterization", times["loss"] / times["cpu, no loss"], "<=", 0.5),
        ("100k Gaussians over 20k", times["cpu, 100k"] / base, "<=", 1.9),
        ("image error, root mean square", found["cpu"]["image"], "<=", 1e-6),
        ("image error, largest", found["cpu"]["image at worst"], "<=", 1e-6),
        ("gradient error, relative", found["cpu"]["gradient"], "<=", 1e-4),
        ("gradients differ between 1, 2, 4 threads", float(not equal_bits()), "<=", 0),
        ("peak growth over 64 bytes a pair + images", memory["growth"] / (64 * memory["pairs"] + memory["images"]),
         "<=", 1.0),
    ]  # fmt: skip

    print(*describe(), sep="\n")
    print(f"{N} Gaussians, {SIZE[0]}x{SIZE[1]}, {CHANNELS} channels; fastest of {options.rounds} rounds")
    print(f"{rate / 1e9:.1f} G multiply-adds/s a thread; {n_pairs} contributing pairs; floor {floor:.2f} ms, kernels "
          f"{kernels:.2f} ms; {100 * found['cpu']['left out']:.2f}% of pixels undecided")  # fmt: skip
    for name, ms in times.items():
        print(f"  {name:<36} {ms:9.2f} ms")
    rows: list[dict[str, Any]] = [{"what": name, "value": ms, "unit": "ms"} for name, ms in times.items()]
    for what, value, relation, bar in bars:
        within = value >= bar if relation == ">=" else value <= bar
        print(f"  {what:<44} {value:9.3g}   {relation} {bar:<7g} {'' if within else 'MISSED'}")
        rows.append({"what": what, "value": value, "unit": "ratio", "bar": f"{relation} {bar:g}", "within": within})
    rows += [{"what": f"{name}: {kind}", "value": value, "unit": "error"} for name, kinds in found.items()
             for kind, value in kinds.items()]  # fmt: skip
    with open(options.out / "rasterize.csv", "w", newline="") as handle:
        writer = csv.DictWriter(handle, ["what", "value", "unit", "bar", "within"])
        writer.writeheader()
        writer.writerows(rows)
    points = {name: (times[name], found[name.split(",")[0]]) for name in times
              if name.split(",")[0] in found and ("thread" in name or name == "cuda")}  # fmt: skip
    draw(options.out / "rasterize.png", points, times["reference f64, 4 threads"])
    print(f"{options.out}/rasterize.csv, {options.out}/rasterize.png; {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
