"""Runs that are killed or stopped at random moments: nothing half, no process left, the same bytes
in the end.
"""

from __future__ import annotations

import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from soak.tiny import Run, contents, different, hidden, kill

IN_A_ROW = 6  # blows to one scene before it may finish
AT_ONCE = 2
ORPHAN = 5.0  # seconds after which a process that is left counts as one


@dataclass
class Blow:
    """What one kill or stop did: seconds until no process was left; fault: empty if all is well."""

    how: str
    delay: float
    code: int
    seconds: float
    fault: str


def all_at_once(run: Run) -> None:
    for number in run.alive():
        kill(number, signal.SIGKILL)


def a_job(run: Run) -> None:
    """kill -9 of a job, as soon as there is one; the run then ends by itself."""
    while run.process.poll() is None:
        if jobs := run.jobs():
            kill(jobs[-1], signal.SIGKILL)
            run.finish()
            return
        time.sleep(0.02)


HOW: dict[str, Callable[[Run], None]] = {
    "kill -9 the run": lambda run: kill(run.process.pid, signal.SIGKILL),
    "kill -9 a job": a_job,
    "kill -9 all": all_at_once,
    "SIGTERM the run": lambda run: kill(run.process.pid, signal.SIGTERM),
    "SIGINT the run": lambda run: kill(run.process.pid, signal.SIGINT),
}
CODES = {"SIGTERM the run": 143, "SIGINT the run": 130}


def turns(kills: int, stops: int) -> list[str]:
    """Which blow comes when: the three kills by turns, stops spread among them."""
    names = list(HOW)
    blows = [names[k % 3] for k in range(kills)]
    for k in range(stops):
        blows.insert((k * (len(blows) + 1)) // max(stops, 1), names[3 if k % 5 else 4])
    return blows


def strike(run: Run, how: str, delay: float, whole: dict[str, str]) -> Blow | None:
    """One blow; None if the run was done before."""
    time.sleep(delay)
    if run.process.poll() is not None:
        return None
    HOW[how](run)
    seconds = run.seconds_to_end()
    code, fault = run.finish(), ""
    if seconds > ORPHAN:
        fault = f"processes left for {seconds:.1f} s"
    if "Traceback" in run.stderr:
        fault = "a traceback"
    if code == 0:
        return None
    if how in CODES and code != CODES[how]:
        fault = f"exit code {code}"
    if how in CODES and hidden_by(run):
        fault = f"left {hidden_by(run)[0].name}"
    return Blow(how, delay, code, seconds, fault or different(run.work, whole))


def hidden_by(run: Run) -> list[Path]:
    """Unfinished artifacts of processes that could have removed them (states of a training are
    kept).
    """
    return [
        path
        for path in hidden(run.work)
        if path.name.startswith(".tmp-") and path not in run.before
    ]


def undisturbed(work: Path) -> tuple[dict[str, str], float]:
    """Contents and seconds of a run whose kernels are compiled."""
    for name in ("compiled", "undisturbed"):
        began, run = time.monotonic(), Run(work / name)
        if run.finish():
            raise RuntimeError(run.stderr)
        seconds = time.monotonic() - began
    whole, again = (contents(work / name) for name in ("undisturbed", "compiled"))
    if whole != again:
        raise RuntimeError("two undisturbed runs differ; nothing can be compared with them")
    return whole, seconds


def lane(
    folder: Path, blows: list[str], whole: dict[str, str], seconds: float, seed: int
) -> tuple[list[Blow], int]:
    """Blows to one scene after another in `folder`; those that hit, and how many scenes were
    finished afterwards.
    """
    rng, waiting, hit, finished = random.Random(seed), list(blows), [], 0
    while waiting:
        work, some = folder / f"{seed}-{finished}", 0
        while waiting and some < IN_A_ROW:
            blow = strike(Run(work), waiting[0], rng.uniform(0.2, 0.3 * seconds), whole)
            if blow is None:
                break
            some += 1
            waiting.pop(0)
            hit.append(blow)
            print(f"kills: {blow.how} after {blow.delay:.1f} s, gone in {blow.seconds:.1f} s, "
                  f"{len(waiting)} to come"
                  f"{'; ' + blow.fault if blow.fault else ''}", file=sys.stderr,
                  flush=True)  # fmt: skip
        run = Run(work)
        fault = (
            f"exit code {run.finish()}: {run.stderr[-300:]}"
            if run.finish()
            else different(work, whole, True)
        )
        finished += 1
        if fault:
            print(f"kills: the run after {some} blows: {fault}", file=sys.stderr, flush=True)
            hit.append(Blow("undisturbed afterwards", 0, run.finish(), 0, fault))
        else:
            shutil.rmtree(work)
    return hit, finished


def kills(folder: Path, kills: int, stops: int) -> tuple[list[Blow], int]:
    """All blows, and how many scenes were finished after theirs."""
    whole, seconds = undisturbed(folder)
    blows = turns(kills, stops)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        lanes = [
            pool.submit(lane, folder, blows[k::AT_ONCE], whole, seconds, k) for k in range(AT_ONCE)
        ]
        found = [lane.result() for lane in lanes]
    return [blow for some, _ in found for blow in some], sum(count for _, count in found)
