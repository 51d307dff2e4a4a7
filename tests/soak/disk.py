"""Runs whose disk is full at a random point: exit code 4, nothing half, and they finish when there
is room again.

The disk is a tmpfs in a mount namespace of its own, which ends with the process; without the right
to make one there is nothing to try.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from soak.tiny import Run, contents, different, hidden

SIZE = 64 << 20  # bytes


@dataclass
class Full:
    """A run to a stage that found so many bytes free of the many that it wants. fault: empty if all
    is well.
    """

    stage: str
    free: int
    wanted: int
    code: int
    finished: int  # artifacts before the disk was full
    again: int
    fault: str


def namespace() -> list[str] | None:
    """A command that runs another one where it may mount; None if there is none."""
    for extra in ([], ["--user", "--map-root-user"]):
        command = ["unshare", "--mount", *extra]
        try:
            tried = subprocess.run(
                [*command, "mount", "-t", "tmpfs", "tmpfs", "/tmp"], capture_output=True
            )
        except FileNotFoundError:
            return None
        if tried.returncode == 0:
            return command
    return None


def mount(folder: Path, options: str) -> None:
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)


def leave(disk: Path, free: int) -> Path:
    """Fill a disk but for so many bytes; the file to delete for having them again."""
    filler = disk / "filler"
    with filler.open("wb") as handle:
        os.posix_fallocate(handle.fileno(), 0, shutil.disk_usage(disk).free - free)
    return filler


def one(disk: Path, number: int, stage: str, free: int, wanted: int, whole: dict[str, str]) -> Full:
    work, words = disk / f"work-{number}", disk.parent / f"{number}.stderr"
    filler = leave(disk, free)
    run = Run(work, stage=stage, words=words)
    code, fault = run.finish(), ""
    done = [path.parent.name for path in work.glob("store/*/[!.]*")]
    if code != 4:
        fault = f"exit code {code}"
    elif "Traceback" in run.stderr or str(disk) not in run.stderr or "make room" not in run.stderr:
        fault = "no clear message"
    elif half := [path for path in hidden(work) if path.name.startswith(".tmp-")]:
        fault = f"left {half[0].name}"
    fault = fault or different(work, whole)
    filler.unlink()
    again = Run(work, stage=stage, words=words.with_suffix(".again")).finish()
    fault = fault or (f"exit code {again} with room" if again else different(work, whole, True))
    shutil.rmtree(work)
    return Full(stage, free, wanted, code, len(done), again, fault)


def disks(folder: Path, count: int, seed: int = 0) -> list[Full]:
    """Full disks of a random free size, in the namespace; by turns for what a disk meets first, and
    for all stages.
    """
    disk, needs = folder / "disk", {}
    mount(disk, f"size={SIZE}")
    for stage in ("teacher", "export"):
        before, run = (
            shutil.disk_usage(disk).free,
            Run(disk / stage, stage=stage, words=folder / f"{stage}.stderr"),
        )
        if run.finish():
            raise RuntimeError(run.stderr)
        needs[stage] = (before - shutil.disk_usage(disk).free, contents(disk / stage))
        shutil.rmtree(disk / stage)
    rng, rows = random.Random(seed), []
    for number in range(count):
        stage = list(needs)[number % len(needs)]
        wanted, whole = needs[stage]
        rows.append(one(disk, number, stage, int(rng.uniform(0.002, 0.9) * wanted), wanted, whole))
        row = rows[-1]
        print(f"disk: {row.free:,} of {row.wanted:,} bytes free: exit code {row.code} after "
              f"{row.finished} artifacts, "
              f"then {row.again}{'; ' + row.fault if row.fault else ''}", file=sys.stderr,
              flush=True)  # fmt: skip
    return rows


if __name__ == "__main__":
    json.dump([asdict(row) for row in disks(Path(sys.argv[1]), int(sys.argv[2]))], sys.stdout)
