"""Threads that share a kernel's work.

A kernel lets go of Python's lock and writes only what belongs to its own part, so threads need
nothing from each other until all are done. Numba's own `prange` does the same, and takes twice as
long to compile.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np

Kernel = Callable[..., None]

_workers: list[Worker] = []
_count = 0


def cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def n_threads() -> int:
    """Threads that a kernel may use: OMP_NUM_THREADS where it is set, else all allowed cores."""
    setting = os.environ.get("OMP_NUM_THREADS", "")
    return _count or (int(setting) if setting.isdecimal() and int(setting) else cores())


def set_n_threads(count: int) -> None:
    """Let kernels use so many threads from now on; 0: as the environment says."""
    global _count
    if count < 0:
        raise ValueError(f"{count} threads")
    _count = count


def in_parts(kernel: Kernel, n: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) for parts of 0...n − 1, one a thread, and wait."""
    parts = max(min(n_threads(), n), 1)
    bounds = [part * n // parts for part in range(parts + 1)]
    _run(kernel, [(*pair, *arguments) for pair in itertools.pairwise(bounds)])


def in_every_thread(kernel: Kernel, *arguments: Any) -> None:
    """Call kernel(*arguments) in every thread, and wait: for a kernel that takes its work from a
    queue.
    """
    _run(kernel, [arguments] * n_threads())


def _run(kernel: Kernel, calls: Sequence[Sequence[Any]]) -> None:
    """The first call in this thread, the others in workers. Raises the first failure.

    Choices: an interrupt waits for the workers, which write into arrays of the caller's. A kernel
      that calls this itself would wait for ever.
    """
    others = calls[1:]
    while len(_workers) < len(others):
        _workers.append(Worker())
    finished = np.zeros(len(others), np.int64)
    failures: SimpleQueue[BaseException | None] = SimpleQueue()
    for k, arguments in enumerate(others):
        _workers[k].take(kernel, arguments, failures, finished[k : k + 1])
    try:
        kernel(*calls[0])
        _wait_a_moment(finished, 1)
    finally:
        failed = [failures.get() for _ in others]
    for failure in failed:
        if failure is not None:
            raise failure


class Worker:
    """A thread that makes calls one after another, and waits a moment before it sleeps."""

    def __init__(self) -> None:
        self.jobs: SimpleQueue[tuple[Any, ...]] = SimpleQueue()
        self.taken = np.zeros(1, np.int64)  # jobs so far
        _wait_a_moment(self.taken, 0)  # what cannot be compiled fails here, and not in the thread
        threading.Thread(target=self._work, daemon=True, name="kernels").start()

    def take(self, *job: Any) -> None:
        """Add a job: kernel, its arguments, a queue for its failure, a mark to set when done."""
        self.jobs.put(job)
        self.taken += 1

    def _work(self) -> None:
        for number in itertools.count(1):
            _wait_a_moment(self.taken, number)
            self._do(*self.jobs.get())

    def _do(self, kernel: Kernel, arguments: Sequence[Any], failures: Any, mark: Any) -> None:
        failure = None
        try:
            kernel(*arguments)
        except BaseException as error:
            failure = error
        failures.put(failure)
        mark[0] = 1


def _wait_a_moment(counters: np.ndarray, least: int) -> None:
    from chebsplat.kernels.waiting import wait_a_moment  # of numba, which counting needs not

    wait_a_moment(counters, least)


# a forked process has none of its parent's threads
os.register_at_fork(after_in_child=_workers.clear)
