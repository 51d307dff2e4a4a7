"""A row of the table: what is damaged how, the command that meets it, and what the command must
answer.
"""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.pipelines.cli import main

SECONDS = 20.0  # of a process of its own
BYTES = 2**30  # of its memory
Arguments = Sequence[str | Path]


@dataclass(frozen=True)
class Row:
    """A malformed input and the answer to it.

    kind: the folder or file that is damaged; name: how; build: writes it below an empty folder and
      gives the arguments
    of `chebsplat`; words: what stderr must hold, the name of the file or setting among them; alone:
    in a process of its own, as whatever may block or eat memory.
    """

    kind: str
    name: str
    build: Callable[[Path], Arguments]
    words: tuple[str, ...]
    code: int = 3
    alone: bool = False

    @property
    def id(self) -> str:
        return f"{self.kind}: {self.name}"


@dataclass(frozen=True)
class Answer:
    """peak: bytes of resident memory of a process of its own."""

    code: int | None
    stderr: str
    peak: int = 0


def stage(name: str, folder: Path, config: Mapping[str, Any], **inputs: Path) -> list[str | Path]:
    """Arguments of a stage's own command on a config and input artifacts."""
    file = folder / "config.json"
    file.write_text(json.dumps(config))
    arguments: list[str | Path] = [
        name,
        "--config",
        file,
        "--out",
        folder / "out",
        "--device",
        "cpu",
    ]
    for role, path in inputs.items():
        arguments += [f"--in-{role}", path]
    return arguments


def called(arguments: Arguments) -> Answer:
    """The command's real entry in this process."""
    stderr = io.StringIO()
    code: int | None = 0
    with redirect_stderr(stderr), redirect_stdout(io.StringIO()):
        try:
            main.main([str(argument) for argument in arguments], prog_name="chebsplat")
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except Exception:
            code = 1
            traceback.print_exc()
        finally:
            logging.getLogger().handlers.clear()  # a stage logs to the stderr that it has met
    return Answer(code, stderr.getvalue())


def run_alone(arguments: Arguments, folder: Path, seconds: float = SECONDS) -> Answer:
    """The same in a process of its own, which is killed once it takes too long or too much."""
    command = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", *map(str, arguments)]
    peak = [0]
    with tempfile.TemporaryFile() as stderr:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                   stderr=stderr,
                                   cwd=folder, start_new_session=True)  # fmt: skip
        watch = threading.Thread(target=_watch, args=(process, peak), daemon=True)
        watch.start()
        try:
            code: int | None = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = None
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        watch.join()
        stderr.seek(0)
        return Answer(code, stderr.read().decode(errors="replace"), peak[0])


def _watch(process: subprocess.Popen[bytes], peak: list[int]) -> None:
    """The high-water mark of a process' resident memory; one beyond BYTES is killed before it hurts
    others.
    """
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text()
        except OSError:
            return
        marks = [
            int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM")
        ]
        peak[0] = max(peak[0], *marks, 0)
        if peak[0] > BYTES:
            process.kill()
        time.sleep(0.02)


def state_of(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of every file, but for what a planner remembers: no refused command changes
    them.
    """
    found = (path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    return {
        path: (path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in found
        if ".cache" not in path.parts
    }


def fault_of(row: Row, answer: Answer, changed: bool) -> str:
    """What is wrong with an answer; empty if nothing is. changed: the files below the folder are
    others than before.
    """
    if answer.peak > BYTES:
        return f"took {answer.peak / 2**20:.0f} MiB"
    if answer.code is None:
        return f"not done after {SECONDS:g} s"
    if "Traceback (most recent call last)" in answer.stderr:
        return f"traceback, exit code {answer.code}"
    if answer.code == 0:
        return "accepted"
    if answer.code != row.code:
        return f"exit code {answer.code}, not {row.code}"
    if missing := [word for word in row.words if word not in answer.stderr]:
        return f"does not say {missing}"
    return "left a file, or changed one" if changed else ""
