"""Error against run time of every route to the descriptor, and the growth of sampling; into build/bench/.

Times are the best of several on one thread, except where threads are named. Errors are relative to a region's largest
value: those of the full spectrum against the float64 polynomial, which is itself held against 50 digits, those of the
lowest K eigenpairs against the float64 dense solver with whole eigenspaces.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's and scipy's solvers share small matrices out otherwise

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import scipy
import torch

import chebsplat
from benchmarks import shared
from benchmarks.descriptor.cases import Regions, mpmath_full, regions_of
from benchmarks.descriptor.routes import ROUTES, compiled, dense, printed, reference
from benchmarks.descriptor.sampling import best, sampling_rows, stage_rows

KINDS, SIZES = ("random", "room", "degenerate"), (32, 64, 128)


def others() -> float:
    """Cores that other processes keep busy, while this one sleeps."""
    path = Path("/proc/stat")
    if not path.exists():
        return float("nan")

    def spent() -> tuple[int, int]:
        ticks = [int(v) for v in path.read_text().split("\n")[0].split()[1:9]]
        return sum(ticks) - ticks[3] - ticks[4], sum(ticks)

    busy, total = spent()
    time.sleep(0.5)
    more, of = spent()
    return (os.cpu_count() or 1) * (more - busy) / max(of - total, 1)


def errors(found: torch.Tensor, oracle: torch.Tensor) -> np.ndarray:
    largest = oracle.abs().amax((1, 2, 3))
    worst = (found.double() - oracle.double()).abs().amax((1, 2, 3))
    return (worst / torch.where(largest > 0, largest, 1.0)).numpy()


def first(given: Regions, m: int) -> Regions:
    means, scales, rotmats, mask = given
    return means[:m], scales[:m], rotmats[:m], mask[:m]


def oracle_rows() -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        given = regions_of(kind, 32, 4)
        exact, ours = reference(torch.float64)(given), compiled(given)
        for r in range(4 if kind == "degenerate" else 1):
            truth = mpmath_full(given, r)
            largest = np.abs(truth).max()
            for name, found in (("float64 polynomial", exact), ("ours, compiled float32", ours)):
                error = np.abs(found[r, :, 0].numpy() - truth).max() / largest
                rows.append({"kind": f"{kind} {r}", "route": name, "error": error})
    return rows


def route_rows(sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        for n in sizes:
            given = regions_of(kind, n, 512 if n <= 64 else 128)
            few = first(given, 48)
            oracles = {True: reference(torch.float64)(few), False: reference(torch.float64, "hard")(few)}
            for route in ROUTES:
                part = first(given, route.most)
                base = {"kind": kind, "n": n, "route": route.name}
                try:
                    found = route.run(part)[:48]
                    seconds = best(lambda route=route, part=part: route.run(part), 2) / len(part[0])
                except (RuntimeError, np.linalg.LinAlgError, ValueError) as error:
                    rows.append(base | {"ms": float("nan"), "median": float("nan"), "worst": float("nan")})
                    print(f"{kind} {n} {route.name}: {str(error)[:70]}")
                    continue
                off = errors(found, oracles[route.full][: len(found)])
                rows.append(base | {"ms": 1e3 * seconds, "median": float(np.median(off)), "worst": float(off.max())})
    return rows


def throughput() -> dict[str, float]:
    """Regions a second at n = 64 on one thread, then ours on more, and the bars."""
    given = regions_of("random", 64, 2048)
    figures = {"ours": 512 / best(lambda: compiled(first(given, 512)), 7)}
    figures["batched eigh float32, K = 16"] = 96 / best(lambda: dense(torch.float32, False)(first(given, 96)))
    figures["printed, float32"] = 24 / best(lambda: printed(torch.float32)(first(given, 24)))
    matrices = torch.rand(96, 64, 64)
    matrices = matrices + matrices.mT
    figures["eigh float32 alone, 4 a region"] = 96 / 4 / best(lambda: torch.linalg.eigh(matrices))
    for threads in (1, 2, 4):
        if threads <= numba.config.NUMBA_NUM_THREADS:
            figures[f"cores that others use, before {threads} threads"] = others()
            numba.set_num_threads(threads)
            spent = time.process_time()
            figures[f"ours, 2048 regions, {threads} threads"] = 2048 / best(lambda: compiled(given), 7)
            figures[f"  of one core's time, {threads} threads"] = 8 * 2048 / (time.process_time() - spent)
    numba.set_num_threads(1)
    return figures


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Work against precision: a panel for each number of Gaussians, on the room."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = [row for row in rows if row["kind"] == "room"]
    sizes = sorted({row["n"] for row in shown})
    canvas, axes = pyplot.subplots(1, len(sizes), figsize=(5 * len(sizes), 4.6), sharey=True, squeeze=False)
    for axis, n in zip(axes[0], sizes, strict=True):
        for k, row in enumerate(r for r in shown if r["n"] == n):
            style = {"marker": "os^Dv<>p*hXPd"[k % 13], "s": 140 if "ours, compiled" in row["route"] else 45}
            label = row["route"] + ("" if row["median"] > 0 else " (the oracle)")
            axis.scatter(row["ms"], max(row["median"], 1e-16), label=label, **style)
        axis.set(xscale="log", yscale="log", xlabel="ms a region, one thread", title=f"n = {n}")
        axis.grid(True, which="major", alpha=0.3)
    axes[0, 0].set_ylabel("median error, of the region's maximum")
    axes[0, -1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1))
    canvas.savefig(path, dpi=130, bbox_inches="tight")


def judged(what: str, value: float, bar: float, at_least: bool) -> None:
    passed = value >= bar if at_least else value <= bar
    print(f"  {what:<60} {value:9.3g}  bar {'>=' if at_least else '<='} {bar:g}  {'pass' if passed else 'FAIL'}")


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("descriptor", __doc__)
    parser.add_argument("--quick", action="store_true", help="n = 32 alone, and no process of its own")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    machine = f"{shared.processor()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"{machine}; one thread where nothing else is said")
    versions = {m.__name__: m.__version__ for m in (chebsplat, np, scipy, torch, numba)}
    print(", ".join(f"{name} {version}" for name, version in versions.items()))
    print("\nagainst 50 digits, n = 32, largest error of the region's maximum")
    for row in oracle_rows():
        print(f"  {row['kind']:<14} {row['route']:<26} {row['error']:.1e}")
    rows = route_rows(SIZES[:1] if options.quick else SIZES)
    shared.write_csv(options.out / "descriptor.csv", rows)
    figure(rows, options.out / "descriptor.png")
    print(f"\n{'regions':<11} {'n':>4} {'route':<36} {'ms/region':>10} {'median':>9} {'worst':>9}")
    for row in rows:
        figures = f"{row['ms']:10.3f} {row['median']:9.1e} {row['worst']:9.1e}"
        print(f"{row['kind']:<11} {row['n']:>4} {row['route']:<36} {figures}")
    rates = throughput()
    print("\nregions a second, n = 64, J = 4, D = 8")
    for name, rate in rates.items():
        print(f"  {name:<60} {rate:9.{1 if 'cores' in name else 0}f}")
    sampling = sampling_rows() + ([] if options.quick else stage_rows())
    shared.write_csv(options.out / "sampling.csv", sampling)
    took = {(row["what"], row["n"]): row["ms"] for row in sampling}
    print(f"\n{'sampling, all cores':<34} {'n':>8} {'ms':>9} growth from a tenth")
    for (what, n), ms in took.items():
        growth = f"{ms / took[what, n // 10]:.1f}" if (what, n // 10) in took else ""
        print(f"{what:<34} {n:>8} {ms:9.1f} {growth}")
    print("\nbars")
    ours = [row for row in rows if "ours, compiled" in row["route"]]
    judged("error of float32, median", float(np.median([r["median"] for r in ours])), 5e-7, False)
    judged("error of float32, worst", max(r["worst"] for r in ours), 5e-6, False)
    judged("times batched eigh float32, K = 16", rates["ours"] / rates["batched eigh float32, K = 16"], 8, True)
    judged("times the printed non-symmetric eig", rates["ours"] / rates["printed, float32"], 20, True)
    if (four := rates.get("ours, 2048 regions, 4 threads")) is not None:
        busy = rates["cores that others use, before 4 threads"]
        ratio = four / rates["ours, 2048 regions, 1 threads"]
        judged(f"4 threads over 1, 2048 regions, others on {busy:.1f} cores", ratio, 3, True)
    for what in sorted({w for w, n in took if n == 1_000_000}):
        if "stage" in what:
            judged(f"{what}, 1e5 points, seconds", took[what, 100_000] / 1e3, 8, False)
        judged(f"{what}, growth from 1e5 to 1e6", took[what, 1_000_000] / took[what, 100_000], 12, False)
