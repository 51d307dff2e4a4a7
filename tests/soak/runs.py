"""Run after run in one process, each with settings of its own: memory, open files and hidden files
stay as they are.

Afterwards all scenes but the last are let go, and the store is to hold what its manifests say, to
the byte.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import sys
import tempfile
import time
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path

from chebsplat.formats.manifest import MANIFEST, parse_manifest

WHOLE = 5  # every so many runs one goes on to the export; the others change what is cheap
WARM = 3  # runs before things are counted
GROWTH = 1.1  # of memory, from the first third of runs to the last


@dataclass
class Count:
    """After one run: memory in MiB, and numbers of files."""

    number: int
    stage: str
    seconds: float
    memory: float
    memory_of_jobs: float  # the most of any so far
    open_files: int
    temporary: int
    hidden: int
    support: int  # in .snakemake, .held and .cache


def files(*folders: Path) -> int:
    return sum(path.is_file() for folder in folders for path in folder.rglob("*"))


def measured(number: int, stage: str, seconds: float, work: Path) -> Count:
    status = Path("/proc/self/status").read_text()
    memory = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS"))
    return Count(
        number=number,
        stage=stage,
        seconds=round(seconds, 1),
        memory=round(memory / 2**10, 1),
        memory_of_jobs=round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10, 1),
        open_files=len(os.listdir("/proc/self/fd")),
        temporary=files(Path(tempfile.gettempdir())),
        hidden=len([*work.glob("store/*/.*"), *work.glob(".plans/*")]),
        support=files(*(work / name for name in (".snakemake", ".held", ".cache"))),
    )


def runs(work: Path, count: int) -> list[Count]:
    """All runs, by turns for the cheap stages and for all of them, in this process."""
    from chebsplat.pipelines.planning.plan import Planner
    from chebsplat.pipelines.running.run import execute
    from soak.tiny import SET

    rows: list[Count] = []
    for number in range(count):
        stage, began = "sfm" if number % WHOLE else "export", time.monotonic()
        planner = Planner()
        plan = planner.plan(
            "toy", SET.format(seed=0).replace("max_points=200", f"max_points={200 + number}")
        )
        planner.save()
        with redirect_stdout(sys.stderr):
            if code := execute([plan], stage, 2):
                raise RuntimeError(f"run {number}: exit code {code}")
        rows.append(measured(number, stage, time.monotonic() - began, work))
        print(f"runs: {rows[-1]}", file=sys.stderr, flush=True)
    for place in work.iterdir():  # all scenes but the last are let go
        if place.name not in ("store", plan.title) and not place.name.startswith("."):
            shutil.rmtree(place)
    return rows


def growth(rows: list[Count]) -> list[str]:
    """What is not flat, in words."""
    some = rows[WARM:]
    third = max(len(some) // 3, 1)
    first, last, found = some[:third], some[-third:], []
    for name in ("memory", "memory_of_jobs"):
        before, after = (max(getattr(row, name) for row in part) for part in (first, last))
        if after > GROWTH * before:
            found.append(f"{name} from {before:.0f} to {after:.0f} MiB")
    for name in ("open_files", "temporary", "hidden"):
        before, after = (max(getattr(row, name) for row in part) for part in (first, last))
        if after > before:
            found.append(f"{name} from {before} to {after}")
    return found


def sizes(work: Path) -> tuple[int, int]:
    """Bytes that lie in the store, and that its manifests name."""
    named = 0
    for path in work.glob("store/*/*"):
        named += (
            sum(entry["bytes"] for entry in parse_manifest(path).files.values())
            + (path / MANIFEST).stat().st_size
        )
    return sum(path.stat().st_size for path in (work / "store").rglob("*") if path.is_file()), named


if __name__ == "__main__":
    json.dump(
        [asdict(row) for row in runs(Path(os.environ["CHEBSPLAT_WORK"]), int(sys.argv[1]))],
        sys.stdout,
    )
