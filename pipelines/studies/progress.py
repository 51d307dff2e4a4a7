"""Progress of a study: its measured runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from chebsplat.errors import ChebsplatError

if TYPE_CHECKING:
    from chebsplat.pipelines.studies.study import Run

EVERY = 1.0  # seconds between looks at what is finished
REFRESH = 300.0  # seconds at least between two writings of a study's page while it runs


@contextmanager
def reported(
    runs: Sequence[Run], say: Callable[[str], None], refresh: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Say `n of m done` of every run that is finished while the block runs, and `refresh` what
    shows them now and then.
    """
    waiting = {run.name: run.steps[-1] for run in runs if not run.steps[-1].fresh}
    over = threading.Event()

    def look() -> bool:
        finished = [name for name, last in waiting.items() if last.fresh]
        for name in finished:
            del waiting[name]
            say(f"  {len(runs) - len(waiting)} of {len(runs)} done: {name}")
        return bool(finished)

    def watch() -> None:
        written_at, is_new = time.monotonic(), False
        while not over.wait(EVERY):
            is_new |= look()
            if is_new and time.monotonic() - written_at >= REFRESH:
                try:
                    refresh()
                except (ChebsplatError, OSError) as error:
                    say(f"  the page could not be written: {error}")
                written_at, is_new = time.monotonic(), False

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        look()
