"""How far a study is: which runs are measured, and about how long the others take, by the seconds of finished steps."""

from __future__ import annotations

import json
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from chebsplat.errors import ChebsplatError
from chebsplat.pipelines.plan import Step
from chebsplat.settings import MOST_STEPS

if TYPE_CHECKING:
    from chebsplat.pipelines.studies.study import Run

EVERY = 1.0  # seconds between looks at what is finished
REFRESH = 300.0  # seconds at least between two writings of a study's page while it runs


class Progress:
    """Which runs of a study are measured, and how long the others will take. at_once: jobs that run side by side; None:
    a cluster's queue decides, and nobody knows how long.
    """

    def __init__(self, runs: Sequence[Run], at_once: int | None, say: Callable[[str], None]):
        self.n_runs, self.at_once, self.say = len(runs), at_once, say
        self.seconds: dict[str, float] = {}  # of finished steps, by key
        steps = {run.name: run.steps for run in runs}
        self.steps = list({step.key: step for some in steps.values() for step in some}.values())
        self.waiting = {name: some[-1] for name, some in steps.items() if not self._finished(some[-1])}

    def look(self) -> bool:
        """Say which runs have been finished since the last look; whether there is one."""
        finished = [name for name, last in self.waiting.items() if self._finished(last)]
        for name in finished:
            del self.waiting[name]
            done = f"  run {self.n_runs - len(self.waiting)} of {self.n_runs} is done: {name}"
            left = self.left() if self.waiting else None
            self.say(done if left is None else f"{done}; about {estimate_text(left)} left")
        return bool(finished)

    def left(self) -> float | None:
        """Seconds until all is done; None as long as there is a stage that has never been finished, and on a cluster.

        Choices: a training takes as long as others by its steps (the most, where they are not given), or its budget of
          seconds; any other step as long as the mean of its stage.
        """
        if self.at_once is None:
            return None
        spent: defaultdict[tuple, float] = defaultdict(float)
        amount: defaultdict[tuple, float] = defaultdict(float)
        waiting = [step for step in self.steps if not self._finished(step)]
        for step in self.steps:
            if step.key in self.seconds:
                kind, units = measure(step)
                spent[kind] += self.seconds[step.key]
                amount[kind] += units
        total = 0.0
        for kind, units in map(measure, waiting):
            if not amount[kind]:
                return None
            total += units * spent[kind] / amount[kind]
        return total / max(self.at_once, 1)

    def _finished(self, step: Step) -> bool:
        if step.key not in self.seconds:
            try:
                manifest = json.loads((step.path / "artifact.json").read_text())
                self.seconds[step.key] = float(manifest.get("seconds", 0.0))
            except (OSError, ValueError, AttributeError, TypeError):  # not there, or damaged: its reader says so
                return False
        return True


def measure(step: Step) -> tuple[tuple[str, bool], float]:
    """(what a step's time compares with, in how many units)."""
    settings = step.sections["train"] if step.stage == "train" else {}
    by_clock = settings.get("seconds") is not None
    return (step.stage, by_clock), float(settings["seconds" if by_clock else "steps"] or MOST_STEPS if settings else 1)


def estimate_text(seconds: float) -> str:
    """A length of time, rounded as an estimate is: `40 s`, `12 min`, `2.5 h`."""
    if seconds < 100:
        return f"{max(round(seconds), 1)} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


@contextmanager
def reported(
    runs: Sequence[Run], at_once: int | None, say: Callable[[str], None], refresh: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Say which runs are finished while the block runs, each when it is, and `refresh` what shows them now and then."""
    progress, over = Progress(runs, at_once, say), threading.Event()

    def watch() -> None:
        shown, is_new = time.monotonic(), False
        while not over.wait(EVERY):
            is_new |= progress.look()
            if is_new and time.monotonic() - shown >= REFRESH:
                try:
                    refresh()
                except (ChebsplatError, OSError) as error:
                    say(f"  the page could not be written: {error}")
                shown, is_new = time.monotonic(), False

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        progress.look()
