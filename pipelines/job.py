"""One Snakemake job: a stage in this process, under its artifact's lock."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from chebsplat.errors import ChebsplatError
from chebsplat.formats import disk
from chebsplat.pipelines import store
from chebsplat.pipelines.raw import unchanged
from chebsplat.pipelines.rehearsal import rehearsed
from chebsplat.pipelines.store import say
from chebsplat.stages.command import exit_code, n_threads, publish

CODE = "{:<4d}"  # of a job, written over in place: a full disk does not keep it from being told


def run(plan: Path, key: str) -> int:
    """One Snakemake job; returns the exit code of its step, which is written beside the plan, and so is its log."""
    # Snakemake sets OMP_NUM_THREADS to the one thread that a rule declares; a stage may use all cores of the run.
    if threads := os.environ.get("CHEBSPLAT_THREADS"):
        os.environ |= {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    step, files = read_step(plan, key)
    try:
        with disk.explained(plan.parent), logged(Path(f"{files}.log")):
            code = exit_code(lambda: make(plan, key))
    except ChebsplatError as error:  # there cannot be a log
        say(f"{step['stage']}: {error}")
        code = error.exit_code
    with Path(f"{files}.exit").open("r+") as handle:
        handle.write(CODE.format(code))
    return code


def read_step(plan: Path, key: str) -> tuple[dict[str, Any], Path]:
    """A step of a plan, and the path that the names of its files beside the plan begin with."""
    step = next(s for s in json.loads(plan.read_text())["steps"] if s["key"] == key)
    return step, plan.parent / f"{step['stage']}-{key}"


def make(plan: Path, key: str) -> None:
    """Run a step's stage in this process, under its artifact's lock; a twin in another run is waited for.

    Raises: ChebsplatError, Stopped.
    """
    step, files = read_step(plan, key)
    stage, out = step["stage"], Path(step["path"])
    inputs = {role: Path(path) for role, path in step["inputs"].items()}
    with disk.explained(plan.parent), alone(out):
        store.remove_half(out)
        config, hashes = Path(f"{files}.json"), json.loads(Path(f"{files}.raw.json").read_text())
        module = import_module(f"chebsplat.stages.{stage}")
        publish(stage, module.run, out, inputs, config, key=key, code=step["code"], device=step["device"],
                within=prepared(step, hashes))  # fmt: skip


@contextmanager
def prepared(step: dict[str, Any], hashes: dict[str, Any]) -> Iterator[None]:
    """What a stage reads stays as it was planned, and the first training on a processor has its kernels."""
    with ExitStack() as entered:
        entered.enter_context(unchanged(step["stage"], step["config"], hashes))
        if step["stage"] == "train" and step["device"] != "cuda":
            entered.enter_context(rehearsed(n_threads(), "features" in step["inputs"]))
        yield


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """What is logged within goes to a file as well."""
    log = _Log(path)
    logging.getLogger("chebsplat").addHandler(log)
    try:
        yield
    finally:
        logging.getLogger("chebsplat").removeHandler(log)
        with suppress(OSError):
            log.close()


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
