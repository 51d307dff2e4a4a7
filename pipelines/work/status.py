"""What runs, waits and has failed: of the runs under way, here or on a cluster, and of those that ended badly."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.pipelines.work import store

RUNS, FAILED, WAITS, LEFT, DONE = "runs", "failed", "waits", "not begun", "done"
LINES = 5  # of a failed step's log


@dataclass(frozen=True)
class State:
    """A step of a run: what is the matter with it, in words, and its log where that says more."""

    stage: str
    key: str
    what: str
    words: str = ""
    log: tuple[str, ...] = ()


def state_of(folder: Path, step: dict[str, Any]) -> State:
    """How far a step is. folder: of the run's plan."""
    stage, key, file = step["stage"], step["key"], folder / f"{step['stage']}-{step['key']}"
    if store.is_fresh(Path(step["path"])):
        return State(stage, key, DONE)
    if machine := store.holder(store.lease(folder.parents[1], file.name)):
        return State(stage, key, RUNS, f"{seconds(file.with_suffix('.exit'))} s on {machine}")
    log, is_over = file.with_suffix(".log"), store.holder(store.run_lease(folder)) is None
    if code := int(file.with_suffix(".exit").read_text()):
        return State(stage, key, FAILED, f"exit code {code}", last_lines(log))
    if log.is_file() and is_over:
        return State(stage, key, FAILED, "killed before it could report", last_lines(log))
    return State(stage, key, LEFT if is_over else WAITS)


def seconds(file: Path) -> int:
    """Since a file was written, which what it belongs to does as it begins."""
    return max(int(store.age(file)), 0)


def last_lines(log: Path) -> tuple[str, ...]:
    """The end of a log, and where it lies."""
    try:
        lines = log.read_text(errors="replace").strip().splitlines()[-LINES:]
    except OSError:
        lines = []
    return (*lines, str(log))


def runs() -> Iterator[tuple[str, list[State]]]:
    """Every run that `work` knows of, in words, with the states of its steps."""
    for plan in sorted(store.work().glob(".plans/*/plan.json")):
        try:
            steps = json.loads(plan.read_text())["steps"]
            states = [state_of(plan.parent, step) for step in steps]
        except FileNotFoundError:  # it has just ended
            continue
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            yield f"{plan} is damaged; remove {plan.parent} if no run is under way", []
            continue
        machine = store.holder(store.run_lease(plan.parent))
        since = f" on {machine}, {seconds(plan)} s" if machine else ", over"
        yield f"run {plan.parent.name}{since}", states


def lines() -> Iterator[str]:
    """What there is to say of all runs."""
    for title, states in runs():
        count = Counter(state.what for state in states)
        yield f"{title}: " + ", ".join(
            f"{count[what]} {what}" for what in (DONE, RUNS, WAITS, LEFT, FAILED) if count[what]
        )
        for state in states:
            if state.what in (RUNS, FAILED):
                yield f"  {state.what:6s}  {state.stage:9s} {state.key}  {state.words}"
                yield from (f"    {line}" for line in state.log)
        for what in (WAITS, LEFT):
            if stages := Counter(state.stage for state in states if state.what == what):
                yield f"  {what}: " + ", ".join(f"{n} {stage}" for stage, n in stages.items())
