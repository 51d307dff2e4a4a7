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
from chebsplat.kernels.threads import n_threads
from chebsplat.pipelines.planning.raw import unchanged
from chebsplat.pipelines.running.precompile import precompile
from chebsplat.pipelines.work import leases, store
from chebsplat.pipelines.work.store import say
from chebsplat.stages.runtime.command import Planned, publish
from chebsplat.stages.runtime.stopping import exit_code

FINAL = {error.exit_code for error in (ConfigError, InputError, DataFailure)}
CODE = "{:<4d}"  # exit code, overwritten in place, which works on a full disk too


def run(plan: Path, key: str, again: bool = False) -> int:
    """Run one step as a Snakemake job; its exit code and log are written beside the plan.

    Args: again: this may be a retry with more memory; errors of settings or data are not retried.
    Returns: the exit code.
    """
    _, files = read_step(plan, key)
    exit_file = Path(f"{files}.exit")
    if again and (earlier := int(exit_file.read_text())) in FINAL:
        return earlier
    os.utime(exit_file)  # the start time that `status` shows
    with log_to_file(Path(f"{files}.log")):
        code = exit_code(lambda: make(plan, key), plan.parent)
    with exit_file.open("r+") as handle:
        handle.write(CODE.format(code))
    return code


def use_threads() -> None:
    """Set thread counts; to be called before torch is imported. Snakemake sets
    OMP_NUM_THREADS to the one thread that a rule declares; a stage may use all cores of the run.
    """
    if threads := os.environ.get("CHEBSPLAT_THREADS"):
        os.environ["OMP_NUM_THREADS"] = threads


def read_step(plan: Path, key: str) -> tuple[dict[str, Any], Path]:
    """A step of a plan, and the path prefix of its files beside the plan."""
    step = next(s for s in json.loads(plan.read_text())["steps"] if s["key"] == key)
    return step, plan.parent / f"{step['stage']}-{key}"


def make(plan: Path, key: str) -> None:
    """Run a step's stage in this process under its artifact's lease, after another run that holds
    it. Nothing is done where the artifact exists: a job whose node was lost restarts with its first
    step.

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

    with leases.hold(lease, wait):
        store.remove_half(out)
        config, hashes = Path(f"{files}.json"), json.loads(Path(f"{files}.raw.json").read_text())
        module = import_module(f"chebsplat.stages.{stage}")
        planned = Planned(key, step["code"], prepare_stage(step, hashes), step["expected"])
        publish(stage, module.run, out, inputs, config, planned=planned, device=step["device"])


@contextmanager
def prepare_stage(step: dict[str, Any], hashes: dict[str, Any]) -> Iterator[None]:
    """Check raw files before and after a stage, and compile a CPU training's kernels before it."""
    with ExitStack() as stack:
        stack.enter_context(unchanged(step["stage"], step["config"], hashes))
        if step["stage"] == "train" and step["device"] != "cuda":
            stack.enter_context(precompile(n_threads(), "features" in step["inputs"]))
        yield


@contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """Log to a file as well within the block; a full disk costs the log, not the stage."""
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
