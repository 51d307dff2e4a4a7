"""One malformed input: what is written, which command meets it, and what the command must answer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECONDS = 20.0
BYTES = 2**30
CODES = (2, 3, 4)
COMMAND = (sys.executable, "-P", "-m", "chebsplat.pipelines.cli")


@dataclass(frozen=True)
class Asked:
    """A command line, and what stderr must name.

    arguments: of `chebsplat`; named: the file's name, or the setting's; env: variables beside the test's own.
    """

    arguments: Sequence[str | Path]
    named: str
    env: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """`build` writes the input below an empty folder and says what to ask; `codes` are the exit codes it may end in."""

    kind: str
    name: str
    build: Callable[[Path], Asked]
    codes: tuple[int, ...] = CODES

    @property
    def id(self) -> str:
        return f"{self.kind}: {self.name}"


@dataclass(frozen=True)
class Outcome:
    """What became of a case. peak: bytes of resident memory of the command's process; fault: empty if all is well."""

    code: int | None
    seconds: float
    peak: int
    stderr: str
    fault: str


def stage(name: str, folder: Path, config: Mapping[str, Any] | str, named: str, **inputs: Path) -> Asked:
    """A stage's own command on a config (or its text) and input artifacts."""
    file = folder / "config.json"
    file.write_text(config if isinstance(config, str) else json.dumps(config))
    arguments: list[str | Path] = [name, "--config", file, "--out", folder / "out", "--device", "cpu"]
    for role, path in inputs.items():
        arguments += [f"--in-{role}", path]
    return Asked(arguments, named)


def ingest(folder: Path, source: Path, named: str, kind: str | None = None, **settings: Any) -> Asked:
    """The ingest stage on a source's folder; `kind` as detected by the planner where it is None."""
    if kind is None:
        from chebsplat.stages.sources.common import detect

        kind = detect(source)
    sections = {"source": {"kind": kind, "path": str(source)}, "ingest": {"min_views": 2} | settings}
    return stage("ingest", folder, sections, named)


def run(case: Case, folder: Path) -> Outcome:
    """Build and run one case in `folder`, which must be empty."""
    asked = case.build(folder)
    env = os.environ | {"CHEBSPLAT_WORK": str(folder / "work")} | dict(asked.env)
    began, peak = time.perf_counter(), [0]
    with (folder / "stderr").open("wb") as stderr:
        command = [*COMMAND, *map(str, asked.arguments)]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr,
                                   cwd=folder, env=env, start_new_session=True)  # fmt: skip
        watch = threading.Thread(target=_watch, args=(process, peak), daemon=True)
        watch.start()
        try:
            code: int | None = process.wait(SECONDS)
        except subprocess.TimeoutExpired:
            code = None
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        watch.join()
    text = (folder / "stderr").read_text(errors="replace")
    seconds = time.perf_counter() - began
    return Outcome(code, seconds, peak[0], text, _fault(case, asked, code, peak[0], text, folder))


def _watch(process: subprocess.Popen[bytes], peak: list[int]) -> None:
    """The high-water mark of a process' resident memory; one beyond BYTES is killed before it hurts others."""
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text()
        except OSError:
            return
        marks = [int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM")]
        peak[0] = max(peak[0], *marks, 0)
        if peak[0] > BYTES:
            process.kill()
        time.sleep(0.02)


def _fault(case: Case, asked: Asked, code: int | None, peak: int, stderr: str, folder: Path) -> str:
    if peak > BYTES:
        return f"took {peak / 2**20:.0f} MiB"
    if code is None:
        return f"not done after {SECONDS:g} s"
    if "Traceback (most recent call last)" in stderr:
        return f"traceback, exit code {code}"
    if code == 0:
        return "accepted"
    if code not in case.codes:
        return f"exit code {code}"
    if asked.named not in stderr:
        return f"does not name {asked.named}"
    if (folder / "out").exists() or list((folder / "work").glob("store/*/[!.]*")):
        return "left an artifact"
    return ""
