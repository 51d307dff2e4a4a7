"""Progress of long work: a bar on a terminal, plain lines elsewhere, each with the time that is
left; a sign of life where nothing is counted; `log.jsonl` always.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO, TypeVar

log = logging.getLogger("chebsplat")
VERBOSE = "CHEBSPLAT_VERBOSE"  # in the environment, so that a run's jobs have it, too
T = TypeVar("T")


def is_verbose() -> bool:
    """True where the console shows details as well (`chebsplat -v`)."""
    return bool(os.environ.get(VERBOSE))


def log_level() -> str:
    """The level of our log on the console."""
    return "DEBUG" if is_verbose() else "INFO"


def duration(seconds: float) -> str:
    """A rounded time: in steps of 5 s, from 100 s on in minutes, from 100 minutes on in hours."""
    if seconds < 100:
        return f"{max(5 * round(seconds / 5), 5)} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


class Progress:
    """`show` forces or forbids the bar; by default it follows whether stderr is a terminal.

    every: seconds between plain lines, and the most without any within `alive`. expected: seconds
    of all the work, of which this is said as long as nothing better is known.
    """

    def __init__(self, show: bool | None = None, every: float = 6.0, expected: float | None = None):
        self.show = (sys.stderr is not None and sys.stderr.isatty()) if show is None else show
        self.every, self.expected = every, expected
        self.began = self.said = time.perf_counter()
        self._bar = ""  # that stands on the terminal's last line, unfinished
        self._log: TextIO | None = None

    @contextmanager
    def log_to(self, path: Path) -> Iterator[None]:
        with path.open("w") as self._log:
            try:
                yield
            finally:
                self._log = None

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Say how long the work should take, if longer than `every` seconds, and how long it has
        taken wherever a fifth more than these pass in silence.
        """
        if self.expected is not None and self.expected > self.every:
            self._say(self._left().strip())  # its process took seconds to begin
        over = threading.Event()

        def watch() -> None:
            while not over.wait(min(self.every / 8, 1)):
                if time.perf_counter() - self.said >= 1.2 * self.every:
                    since = f"{time.perf_counter() - self.began:.0f} s so far{self._left()}"
                    self._say(f"{self._bar}  {since}" if self._bar else since)

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _say(self, line: str, end: str = "") -> None:
        """A line in the place of the bar, or where there is none, of the log."""
        self.said = time.perf_counter()
        if self.show and self._bar:
            print(f"\r\x1b[K{line}", end=end, file=sys.stderr, flush=True)
        else:
            log.info("%s", line)

    def _left(self, ran: float = 0.0, rest: float | None = None) -> str:
        """Time left for all, in words; empty where nothing is known.

        Args: ran: s that a loop has run, and rest: s that it needs by its own rate.
        Choices: items of a loop differ in cost, and other loops follow: of what is said the rate
          has the part that the loop has run of all that is expected, the forecast has the others.
        """
        if self.expected is not None:
            ahead = self.expected - (time.perf_counter() - self.began)
            part = min(ran / self.expected, 1) if rest is not None else 0
            if ahead > 0:
                rest = (1 - part) * ahead + part * (rest or 0)
        return "" if rest is None else f"  about {duration(rest)} left"

    def record(self, **values: Any) -> None:
        """One line of `log.jsonl`."""
        if self._log is not None:
            self._log.write(json.dumps(values) + "\n")

    @contextmanager
    def ticker(self, total: int, what: str) -> Iterator[Callable[[], None]]:
        """A function to call after each of `total` steps of a library's loop, which may be fewer;
        further calls have no effect.
        """
        steps = self.track(range(total), total, what)
        next(steps, None)

        def tick() -> None:
            next(steps, None)

        yield tick
        steps.close()

    def track(
        self, items: Iterable[T], total: int | Callable[[], int], what: str, start: int = 0
    ) -> Generator[tuple[T, dict[str, Any]], None, None]:
        """Yield (item, status); the caller's entries in `status` are shown beside rate and time
        left.

        total: number of items, `start` of them done before; a function where it changes on the way.
        """
        status: dict[str, Any] = {}
        if start:  # the forecast is of all the work, of which an earlier process has done a part
            self.expected = None
        began = last = time.perf_counter()
        # the first item warms up and is not counted in the rate
        try:
            for index, item in enumerate(items):
                yield item, status
                now = time.perf_counter()
                if index == 0:
                    began = now
                at = index + start + 1
                n = total if isinstance(total, int) else total()
                if now - last >= (0.2 if self.show else self.every) or at == n:
                    last = now
                    rate = index / max(now - began, 1e-9)
                    rest = (n - at) / rate if rate > 0 and at < n else None
                    notes = "".join(f"  {k} {v}" for k, v in status.items())
                    self._bar = f"{what} {at}/{n}{notes}" + (f"  {rate:.1f}/s" if index else "")
                    self._say(
                        self._bar + self._left(now - began, rest), end="\n" if at == n else ""
                    )
        finally:
            if self.show and self._bar and index + start + 1 < n:
                print(file=sys.stderr, flush=True)  # nothing is written over an unfinished bar
            self._bar = ""
