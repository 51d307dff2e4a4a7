"""The smallest runs that have every kind of writer in them, and what is to be known of their
processes and files.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from chebsplat.errors import InputError
from chebsplat.formats import artifact

ROOT = Path(__file__).parents[2]
SET = (
    "train.steps=12,train.n_densify=1,sfm.max_points=200,evaluate.timing_repeats=0,"
    "knowledge.start=none,train.seed={seed}"
)
MARKER = "CHEBSPLAT_SOAK"  # in the environment of a run and of all that it starts
LOGS = ("log.jsonl", "trace.csv")  # hold seconds


@dataclass
class Run:
    """A run under way in the folder `work`."""

    work: Path
    seed: int = 0
    stage: str = "export"
    environment: dict[str, str] = field(default_factory=dict)
    words: Path = Path()  # its stderr; beside `work` if it is not named

    def __post_init__(self) -> None:
        self.mark = uuid.uuid4().hex
        self.before = set(hidden(self.work))  # left by earlier runs
        if self.words == Path():
            self.words = self.work.with_name(f"{self.work.name}.stderr")
        command = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", "run", "--scene", "toy"]
        command += ["--set", SET.format(seed=self.seed), "--stage", self.stage, "--cores", "2"]
        environment = (
            os.environ | {"CHEBSPLAT_WORK": str(self.work), MARKER: self.mark} | self.environment
        )
        with self.words.open("wb") as stderr:
            self.process = subprocess.Popen(command, cwd=ROOT, env=environment,
                                            start_new_session=True,
                                            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                            stderr=stderr)  # fmt: skip

    def finish(self, timeout: float = 600) -> int:
        return self.process.wait(timeout)

    @property
    def stderr(self) -> str:
        return self.words.read_text(errors="replace")

    def alive(self) -> list[int]:
        """Processes of the run, zombies aside."""
        return [
            number
            for number in marked(self.mark)
            if number != self.process.pid or self.process.poll() is None
        ]

    def jobs(self) -> list[int]:
        return [number for number in self.alive() if " job " in command_line(number)]

    def seconds_to_end(self, at_most: float = 20) -> float:
        """Until no process of the run is left; those that are after `at_most` are killed."""
        began = time.monotonic()
        while self.alive():
            if time.monotonic() - began > at_most:
                for number in self.alive():
                    kill(number, signal.SIGKILL)
                break
            time.sleep(0.05)
        self.process.wait()
        return time.monotonic() - began


def marked(mark: str) -> list[int]:
    """Processes with this mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if f"{MARKER}={mark}".encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


def command_line(number: int) -> str:
    with suppress(OSError):
        return (
            Path(f"/proc/{number}/cmdline")
            .read_bytes()
            .replace(b"\0", b" ")
            .decode(errors="replace")
        )
    return ""


def kill(number: int, how: signal.Signals, group: bool = False) -> None:
    with suppress(ProcessLookupError):
        (os.killpg if group else os.kill)(number, how)


def artifacts(work: Path) -> list[Path]:
    return sorted(path for path in work.glob("store/*/*") if not path.name.startswith("."))


def different(work: Path, whole: dict[str, str], finished: bool = False) -> str:
    """What is half or not as in the undisturbed run; empty if all is well."""
    try:
        found = contents(work)
    except InputError as error:
        return f"half: {error}"
    other = sorted(name for name, digest in found.items() if whole.get(name) != digest)
    other += sorted(whole.keys() - found.keys()) if finished else []
    return f"not the same bytes: {other[0]} and {len(other) - 1} more" if other else ""


def hidden(work: Path) -> list[Path]:
    """What a stage writes before it is finished."""
    return sorted(work.glob("store/*/.*"))


def contents(work: Path) -> dict[str, str]:
    """sha256 of every member of every artifact, those that hold seconds aside. Raises InputError on
    a half one.
    """
    found = {}
    for path in artifacts(work):
        manifest = artifact.verify(path)
        found |= {
            f"{path.parent.name}/{path.name}/{name}": entry["sha256"]
            for name, entry in manifest.files.items()
            if name not in LOGS
        }
    return found
