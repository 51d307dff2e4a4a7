"""Progress of long work: a bar with rate and ETA on a terminal, plain lines elsewhere."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
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


class Progress:
    """`show` forces or forbids the bar; by default there is one if stderr is a terminal."""

    def __init__(self, show: bool | None = None, every: float = 10.0):
        self.show = (sys.stderr is not None and sys.stderr.isatty()) if show is None else show
        self.every = every  # seconds between plain lines
        self._log: TextIO | None = None

    @contextmanager
    def log_to(self, path: Path) -> Iterator[None]:
        with path.open("w") as self._log:
            try:
                yield
            finally:
                self._log = None

    def record(self, **values: Any) -> None:
        """One line of `log.jsonl`."""
        if self._log is not None:
            self._log.write(json.dumps(values) + "\n")

    def ticker(self, total: int, what: str) -> Callable[[], None]:
        """A function to call after each of `total` steps of a library's loop; further calls have no
        effect.
        """
        steps = self.track(range(total), total, what)
        next(steps, None)

        def tick() -> None:
            next(steps, None)

        return tick

    def track(
        self, items: Iterable[T], total: int | Callable[[], int], what: str, start: int = 0
    ) -> Iterator[tuple[T, dict[str, Any]]]:
        """Yield (item, status); the caller's entries in `status` are shown beside rate and ETA.

        total: number of items, `start` of them done before; a function where it changes on the way.
        """
        status: dict[str, Any] = {}
        began = last = time.perf_counter()
        # the first item warms up and is not counted in the rate
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
                eta = f"{(n - at) / rate:.0f} s" if rate > 0 else "unknown"
                notes = "".join(f"  {k} {v}" for k, v in status.items())
                line = f"{what} {at}/{n}{notes}  {rate:.1f}/s  ETA {eta}"
                if self.show:
                    end = "\n" if at == n else ""
                    print(f"\r\x1b[K{line}", end=end, file=sys.stderr, flush=True)
                else:
                    log.info("%s", line)
