"""`make soak`: kills, full disks, and runs by the hundred; build/soak-*.csv. Arguments: parts, and
counts.

make soak                                  kills=200 stops=50 disk=20 runs=60
make soak args="kills=20 stops=5"          these parts alone
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from soak.disk import Full, namespace
from soak.kills import kills
from soak.runs import WARM, Count, growth, sizes

COUNTS = {"kills": 200, "stops": 50, "disk": 20, "runs": 60}


def counts(arguments: list[str]) -> dict[str, int]:
    asked = dict(argument.split("=", 1) for argument in arguments)
    if unknown := asked.keys() - COUNTS.keys():
        sys.exit(f"soak: {unknown.pop()} is none of {', '.join(COUNTS)}")
    return {name: int(number) for name, number in asked.items()} or COUNTS


def table(name: str, rows: Sequence[Any]) -> Path:
    path = Path(f"build/soak-{name}.csv")
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, [field.name for field in fields(rows[0])])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    return path


def do_kills(folder: Path, asked: dict[str, int]) -> int:
    rows, finished = kills(folder, asked.get("kills", 0), asked.get("stops", 0))
    print(f"{'blow':28s}{'count':>7s}{'longest to end':>16s}{'faults':>8s}")
    for how in dict.fromkeys(row.how for row in rows):
        some = [row for row in rows if row.how == how]
        longest, faults = max(row.seconds for row in some), sum(bool(row.fault) for row in some)
        print(f"{how:28s}{len(some):7d}{longest:14.1f} s{faults:8d}")
    print(
        f"{finished} scenes finished after their blows, with the bytes of an undisturbed run; "
        f"{table('kills', rows)}"
    )
    return sum(bool(row.fault) for row in rows)


def do_disk(folder: Path, asked: dict[str, int]) -> int:
    """In a process of its own, which may mount."""
    command = namespace()
    if command is None:
        print("disk: left out: nothing can be mounted here (root, or user namespaces, are needed)")
        return 0
    inside = [*command, sys.executable, "-m", "soak.disk", str(folder), str(asked["disk"])]
    done = subprocess.run(inside, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        return 1
    rows = [Full(**row) for row in json.loads(done.stdout)]
    faults = sum(bool(row.fault) for row in rows)
    print(f"{len(rows)} disks that were full: {sum(row.code == 4 for row in rows)} exits with 4, "
          f"{sum(row.again == 0 for row in rows)} finished when there was room, {faults} faults; "
          f"{table('disk', rows)}")  # fmt: skip
    return faults


def do_runs(folder: Path, asked: dict[str, int]) -> int:
    """In a process of their own, whose memory and files are counted."""
    work, temporary = folder / "work", folder / "tmp"
    temporary.mkdir()
    environment = os.environ | {"CHEBSPLAT_WORK": str(work), "TMPDIR": str(temporary)}
    command = [sys.executable, "-m", "soak.runs", str(asked["runs"])]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        return 1
    rows = [Count(**row) for row in json.loads(done.stdout)]
    clean = [sys.executable, "-m", "chebsplat.pipelines.cli", "clean-stale", "--yes"]
    subprocess.run(clean, env=environment, check=True)
    there, named = sizes(work)
    faults = growth(rows) + (
        [f"{there} bytes in the store, {named} in its manifests"] if there != named else []
    )
    for row in (rows[0], rows[min(WARM, len(rows) - 1)], rows[len(rows) // 2], rows[-1]):
        print(row)
    print(f"{len(rows)} runs; after clean-stale {there:,} bytes in the store, {named:,} in its "
          "manifests; "
          f"{'; '.join(faults) or 'flat'}; {table('runs', rows)}")  # fmt: skip
    return len(faults)


def main(arguments: list[str]) -> int:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` has runs ignore it
    asked, faults = counts(arguments), 0
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    for part, names in {
        do_kills: ("kills", "stops"),
        do_disk: ("disk",),
        do_runs: ("runs",),
    }.items():
        if any(asked.get(name) for name in names):
            began = time.monotonic()
            place = folder / names[0]
            place.mkdir()
            faults += part(place, asked)
            print(f"{names[0]}: {time.monotonic() - began:.0f} s\n", flush=True)
    if not faults:
        shutil.rmtree(folder)
    print(f"{faults} faults" + (f"; what they left is in {folder}" if faults else ""))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
