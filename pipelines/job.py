"""One Snakemake job: a stage's own command, in this process, under its artifact's lock."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from chebsplat.errors import ChebsplatError
from chebsplat.formats import disk
from chebsplat.pipelines import store
from chebsplat.pipelines.raw import unchanged
from chebsplat.pipelines.store import say

CODE = "{:<4d}"  # of a job, written over in place: a full disk does not keep it from being told


def run(plan: Path, key: str) -> int:
    """One Snakemake job: the stage's own command, in this process; a twin in another run is waited for."""
    # Snakemake sets OMP_NUM_THREADS to the one thread that a rule declares; a stage may use all cores of the run.
    if threads := os.environ.get("CHEBSPLAT_THREADS"):
        os.environ |= {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    step = next(s for s in json.loads(plan.read_text())["steps"] if s["key"] == key)
    files = plan.parent / f"{step['stage']}-{key}"
    try:
        with disk.explained(plan.parent):
            code = in_stage(step, files)
    except ChebsplatError as error:
        say(f"{step['stage']}: {error}")
        code = error.exit_code
    with Path(f"{files}.exit").open("r+") as handle:
        handle.write(CODE.format(code))
    return code


def in_stage(step: dict[str, Any], files: Path) -> int:
    """Run a step's stage under its artifact's lock, with a log beside its config; returns its exit code."""
    from importlib import import_module

    arguments = ["--config", f"{files}.json", "--out", step["path"], "--key", step["key"]]
    arguments += ["--code", json.dumps(step["code"]), "--device", step["device"]]
    for role, path in step["inputs"].items():
        arguments += [f"--in-{role}", path]
    log = _Log(f"{files}.log")
    logging.getLogger("chebsplat").addHandler(log)
    try:
        with alone(Path(step["path"])):
            store.remove_half(Path(step["path"]))
            watch = unchanged(step["stage"], step["config"], json.loads(Path(f"{files}.raw.json").read_text()))
            import_module(f"chebsplat.stages.{step['stage']}").main(arguments, prog_name=step["stage"], obj=watch)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    finally:
        logging.getLogger("chebsplat").removeHandler(log)
        with suppress(OSError):
            log.close()
    return 0


class _Log(logging.FileHandler):
    """A full disk costs the log, not the stage; that meets the disk itself."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold the lock of one artifact; the system releases it when the process ends, however it ends."""
    import fcntl

    file = path.parents[2] / ".locks" / f"{path.parent.name}-{path.name}"
    file.parent.mkdir(exist_ok=True)
    with file.open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"{path.parent.name}: another run is making it; waiting")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
