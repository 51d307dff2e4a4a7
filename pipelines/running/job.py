"""One Snakemake job: a stage in this process, under its artifact's lease."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.pipelines.planning.raw import unchanged
from chebsplat.pipelines.running.precompile import rehearsed
from chebsplat.pipelines.work import leases, store
from chebsplat.pipelines.work.store import say
from chebsplat.stages.runtime.command import Planned, n_threads, publish
from chebsplat.stages.runtime.stopping import exit_code

FINAL = {error.exit_code for error in (ConfigError, InputError, DataFailure)}
CODE = "{:<4d}"  # of a job, written over in place: a full disk does not keep it from being told


def run(plan: Path, key: str, again: bool = False) -> int:
    """One Snakemake job; returns the exit code of its step, which is written beside the plan, and
    so is its log.

    Args: again: it may be another attempt, with more memory. What settings or data do not allow is
      not tried again.
    """
    _, files = read_step(plan, key)
    exit_file = Path(f"{files}.exit")
    if again and (earlier := int(exit_file.read_text())) in FINAL:
        return earlier
    os.utime(exit_file)  # `status` says how long ago
    with logged(Path(f"{files}.log")):
        code = exit_code(lambda: make(plan, key), plan.parent)
    with exit_file.open("r+") as handle:
        handle.write(CODE.format(code))
    return code


def use_threads() -> None:
    """To be called before torch and Numba are imported. Snakemake sets OMP_NUM_THREADS to the one
    thread that a rule declares; a stage may use all cores of the run.
    """
    if threads := os.environ.get("CHEBSPLAT_THREADS"):
        os.environ |= {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}


def read_step(plan: Path, key: str) -> tuple[dict[str, Any], Path]:
    """A step of a plan, and the path that the names of its files beside the plan begin with."""
    step = next(s for s in json.loads(plan.read_text())["steps"] if s["key"] == key)
    return step, plan.parent / f"{step['stage']}-{key}"


def make(plan: Path, key: str) -> None:
    """Run a step's stage in this process, under its artifact's lease; a twin in another run is
    waited for. Nothing is
    done where the artifact is there already: a job whose node was lost begins with its first step
      again.

    Raises: ChebsplatError, Stopped.
    """
    step, files = read_step(plan, key)
    stage, out = step["stage"], Path(step["path"])
    inputs = {role: Path(path) for role, path in step["inputs"].items()}
    if store.is_fresh(out):
        return
    lease = store.lease(out.parents[2], f"{stage}-{key}")

    def wait(machine: str) -> None:
        say(f"{stage}: another run is making it on {machine}; waiting")

    with leases.held(lease, wait):
        store.remove_half(out)
        config, hashes = Path(f"{files}.json"), json.loads(Path(f"{files}.raw.json").read_text())
        module = import_module(f"chebsplat.stages.{stage}")
        within = prepared(step, hashes)
        planned = Planned(key, step["code"], within, step["expected"])
        publish(stage, module.run, out, inputs, config, planned=planned, device=step["device"])


@contextmanager
def prepared(step: dict[str, Any], hashes: dict[str, Any]) -> Iterator[None]:
    """What a stage reads stays as it was planned, and the first training on a processor has its
    kernels.
    """
    with ExitStack() as entered:
        entered.enter_context(unchanged(step["stage"], step["config"], hashes))
        if step["stage"] == "train" and step["device"] != "cuda":
            entered.enter_context(rehearsed(n_threads(), "features" in step["inputs"]))
        yield


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """What is logged within goes to a file as well; a full disk costs the log, not the stage."""
    try:
        log: logging.Handler = _Log(path)
    except OSError:
        log = logging.NullHandler()
    logging.getLogger("chebsplat").addHandler(log)
    try:
        yield
    finally:
        logging.getLogger("chebsplat").removeHandler(log)
        with suppress(OSError):
            log.close()


class _Log(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        pass
