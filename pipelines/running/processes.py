"""Processes of a run: none of them outlives it, however it ends."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from chebsplat.stages.runtime.stopping import PATIENCE

# Snakemake's own log goes to a file; its jobs inherit the real stderr, which may be a terminal. Its
# standard input is a pipe that closes with the run, however that ends: its session then gets
# SIGTERM and, after PATIENCE, SIGKILL. Its cache is beside its other files, as the home folder may
# be full or read-only.
SNAKEMAKE = """
import atexit, json, os, signal, subprocess, sys, threading, time
patience, words, beside, cache = float(sys.argv.pop(1)), *(sys.argv.pop(1) for _ in range(3))
def watch():
    while os.read(0, 1):
        pass
    os.killpg(0, signal.SIGTERM)
    time.sleep(patience)
    os.killpg(0, signal.SIGKILL)
threading.Thread(target=watch, daemon=True).start()
sys.stderr = open(words, "w", 1)
if json.loads(beside):
    atexit.register(subprocess.Popen(json.loads(beside), stderr=subprocess.DEVNULL).kill)
import platformdirs, snakemake.common
own = type("Own", (platformdirs.PlatformDirs,), {"user_cache_dir": cache})
snakemake.common.APPDIRS = own("snakemake", "snakemake")
from snakemake.cli import main
main()
"""


def snakemake(
    words: Path,
    cache: Path,
    arguments: list[str],
    environment: Mapping[str, str],
    beside: Sequence[str] = (),
) -> int:
    """Run Snakemake; returns its exit code when it and all that it has started are gone.

    Args: words: a file for its log; cache: its cache folder; environment: further variables;
      beside: a command of ours that runs meanwhile.
    """
    reader, writer = os.pipe()
    # -P and PYTHONSAFEPATH: modules in the current or the work folder are never imported
    command = [sys.executable, "-P", "-c", SNAKEMAKE, str(PATIENCE), str(words), json.dumps(beside)]
    environment = os.environ | {"PYTHONSAFEPATH": "1", **environment}
    with open(reader, "rb") as standard_input, open(writer, "wb"):
        # a session of its own: a terminal's Ctrl-C reaches the run alone, which ends its jobs
        process = subprocess.Popen(
            [*command, str(cache), *arguments],
            stdin=standard_input,
            stdout=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
        try:
            with pause_together(process):
                while process.poll() is None:  # `wait` does not wake on another thread's signal
                    time.sleep(0.02)
            return process.returncode
        finally:
            if process.poll() != 0:
                end(process)


@contextmanager
def pause_together(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Pass a terminal's Ctrl-Z, which reaches this process alone, to the session of `process`."""

    def pause(_number: int, _frame: FrameType | None) -> None:
        os.killpg(process.pid, signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGSTOP)  # until SIGCONT
        os.killpg(process.pid, signal.SIGCONT)

    before = signal.signal(signal.SIGTSTP, pause)
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, before)


def end(process: subprocess.Popen[bytes]) -> None:
    """Send SIGTERM to the remains of a process's session, and SIGKILL after PATIENCE."""
    with suppress(ProcessLookupError):  # it is gone
        for number in (signal.SIGTERM, signal.SIGKILL):
            os.killpg(process.pid, number)
            os.killpg(process.pid, signal.SIGCONT)  # it may be paused
            until = time.monotonic() + PATIENCE
            while time.monotonic() < until:
                process.poll()
                os.killpg(process.pid, 0)
                time.sleep(0.02)
    process.wait()


def run_in_turn(command: Callable[[list[str]], None], calls: list[list[str]]) -> int:
    """Call a command of ours for each list of arguments until one fails; returns its exit code.

    Each call has a process of its own, forked from one that has imported the common packages and
    done nothing else: a step then starts 1.3 processor seconds sooner, which on a cluster pays for
      grouping steps into a job.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "numba", "zarr"])
    for arguments in calls:
        process = context.Process(target=command, args=(arguments,))
        process.start()
        try:
            process.join()
        finally:
            process.terminate()  # without effect on an ended one
            process.join(PATIENCE)
            process.kill()
        if process.exitcode:
            return process.exitcode if process.exitcode > 0 else 128 - process.exitcode
    return 0
