"""Where the time of repeated work goes."""

from __future__ import annotations

import time


class Laps:
    """Seconds by part of the work: each `mark` books the time since the mark or the start before it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin to measure, or go on after a pause that belongs to no part."""
        self.last = time.perf_counter()

    def mark(self, part: str) -> None:
        """Book the seconds since the last mark or start under `part`."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self.last
        self.last = now
