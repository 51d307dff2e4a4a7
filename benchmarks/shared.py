"""Shared by all benchmarks: arguments, rows as CSV, and the machine that they are measured on."""

from __future__ import annotations

import csv
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numba
import torch

import chebsplat
from chebsplat.kernels.threads import cores, n_threads
from chebsplat.pipelines.planning.plan import Plan, Planner
from chebsplat.pipelines.running.run import execute
from chebsplat.pipelines.work.scenes import data_of
from chebsplat.stages.runtime.machine import load, processor

Bar = tuple[str, float, str, float]  # what, value, ">=" or "<=", bar


def parser(name: str, description: str | None, work: bool = False) -> ArgumentParser:
    """The arguments of benchmark `name`: --out, --work for one on a scene; it adds its own."""
    prog = f"python -m benchmarks {name}"
    arguments = ArgumentParser(
        prog, description=description, formatter_class=RawDescriptionHelpFormatter
    )
    if work:
        arguments.add_argument(
            "--work", type=Path, required=True, help="a scene's links, such as work/office0"
        )
    arguments.add_argument(
        "--out", type=Path, default=Path("build/bench"), help="folder for tables and figures"
    )
    return arguments


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows under all their keys, in order of appearance."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)


def judged(bars: Sequence[Bar]) -> list[bool]:
    """Print values beside their bars, and return which are met; nan, not measured, meets none."""
    met = [value >= bar if relation == ">=" else value <= bar for _, value, relation, bar in bars]
    for (what, value, relation, bar), within in zip(bars, met, strict=True):
        print(f"  {what:<36} {value:9.3g}   {relation} {bar:<7g} {'' if within else 'MISSED'}")
    return [bool(within) for within in met]


def there(scenes: Sequence[str]) -> list[str]:
    """The scenes whose data is there; a line for each of the others."""
    available = []
    for scene in scenes:
        if (needed := data_of(scene)) and not needed[1].is_dir():
            print(f"{scene} is left out: {needed[1]} is not there ({needed[0]})")
        else:
            available.append(scene)
    return available


def finished(runs: Iterable[tuple[str, str]], stage: str) -> list[Plan]:
    """Plans of (scene, settings as `set=` takes them), run up to a stage, without a path for each
    on stdout.

    Raises SystemExit with the run's exit code if a step fails.
    """
    planner = Planner(running=True)
    plans = [planner.plan(scene, settings) for scene, settings in runs]
    planner.save()
    with redirect_stdout(StringIO()):
        code = execute(plans, stage, cores())
    if code:
        raise SystemExit(code)
    return plans


def machine() -> str:
    """Circumstances of figures: versions, threads, processor, load."""
    return (
        f"chebsplat {chebsplat.__version__}, torch {torch.__version__} on "
        f"{torch.get_num_threads()} threads, numba {numba.__version__} on "
        f"{n_threads()}; {processor()}, {cores()} cores, load {load():.1f}"
    )


def peak_memory() -> int:
    """Peak of this process's resident bytes; `ru_maxrss` counts that of its parent, too."""
    status = Path("/proc/self/status").read_text()
    return (
        int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
        * 1024
    )
