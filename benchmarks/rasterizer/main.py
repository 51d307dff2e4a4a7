"""Every bar of the CPU rasterizer in one run, as a ratio beside its bar; a CSV and a work-precision figure.

A step is forward, L1 and backward. Variants take turns, round by round, and the fastest round of each counts: other
load on the machine only ever adds. Errors are against float64.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

import chebsplat
from benchmarks import shared
from benchmarks.rasterizer.accuracy import equal_bits, errors
from benchmarks.rasterizer.actions import (
    CHANNELS,
    SIZE,
    N,
    contributions,
    loss,
    multiply_adds,
    render_and_back,
    stages,
    step,
    threads,
    training_step,
)
from benchmarks.rasterizer.memory import measured

Timed = dict[str, float]  # milliseconds by name


def take_turns(variants: dict[str, tuple[int, Callable[[], object]]], rounds: int) -> Timed:
    """Fastest of `rounds` by name; variants are (threads, action). Each turn begins with a run that does not count:
    it fills the caches, and starts as many threads.
    """
    best = dict.fromkeys(variants, np.inf)
    for _ in range(rounds):
        for name, (n, action) in variants.items():
            threads(n)
            action()
            began = time.perf_counter()
            action()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - began))
    return best


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


def machine() -> list[str]:
    model = shared.processor()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return [
        f"{model} ({numba.config.CPU_NAME or numba.core.cpu.ll.get_host_cpu_name()}), {os.cpu_count()} cores{load}",
        f"chebsplat {chebsplat.__version__}, numba {numba.__version__} ({numba.threading_layer()}, "
        f"OpenMP waits {os.environ.get('OMP_WAIT_POLICY')}), torch {torch.__version__}, Python "
        f"{platform.python_version()}",
    ]


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("raster", __doc__)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--yardstick", default=os.environ.get("YARDSTICK"), type=Path, metavar="FOLDER",
                        help="of yardstick.py, to run beside ours (default: $YARDSTICK)")  # fmt: skip
    options = parser.parse_args(arguments)
    if options.yardstick:
        for n in (1, 2):
            command = [sys.executable, "-P", str(options.yardstick / "yardstick.py"), "--beside", "chebsplat"]
            subprocess.run([*command, "--threads", str(n), "--rounds", str(options.rounds)], check=True)
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

    print(*machine(), sep="\n")
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
    shared.write_csv(options.out / "rasterize.csv", rows)
    points = {name: (times[name], found[name.split(",")[0]]) for name in times
              if name.split(",")[0] in found and ("thread" in name or name == "cuda")}  # fmt: skip
    draw(options.out / "rasterize.png", points, times["reference f64, 4 threads"])
    print(f"{options.out}/rasterize.csv, {options.out}/rasterize.png; {time.perf_counter() - began:.0f} s")
