"""Threads that share a kernel's work.

A kernel lets go of Python's lock and writes only what belongs to its own part, so threads need
nothing from each other until all are done. Numba's own `prange` does the same, and takes twice as
long to compile.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

Kernel = Callable[..., None]
Job = tuple[Kernel, Sequence[Any], "SimpleQueue[BaseException | None]"]

_jobs: SimpleQueue[Job] = SimpleQueue()
_workers: list[threading.Thread] = []
_count = 0


def n_threads() -> int:
    """Threads that a kernel may use: OMP_NUM_THREADS where it is set, else all allowed cores."""
    if _count:
        return _count
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return int(wanted) if wanted.isdigit() and int(wanted) else len(os.sched_getaffinity(0))


def set_n_threads(count: int) -> None:
    """Let kernels use so many threads from now on; 0: as the environment says."""
    global _count
    _count = count


def in_parts(kernel: Kernel, n: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) for parts of 0...n − 1, one a thread, and wait."""
    parts = max(min(n_threads(), n), 1)
    bounds = [part * n // parts for part in range(parts + 1)]
    _run(kernel, [(*pair, *arguments) for pair in pairwise(bounds)])


def in_every_thread(kernel: Kernel, *arguments: Any) -> None:
    """Call kernel(*arguments) in every thread, and wait: for a kernel that takes its work from a
    queue.
    """
    _run(kernel, [arguments] * n_threads())


def _run(kernel: Kernel, calls: Sequence[Sequence[Any]]) -> None:
    """The first call in this thread, the others in workers. Raises the first failure."""
    done: SimpleQueue[BaseException | None] = SimpleQueue()
    while len(_workers) < len(calls) - 1:
        _workers.append(threading.Thread(target=_work, daemon=True, name="kernels"))
        _workers[-1].start()
    for arguments in calls[1:]:
        _jobs.put((kernel, arguments, done))
    first = _attempt(kernel, calls[0])
    for failure in [first, *[done.get() for _ in calls[1:]]]:
        if failure is not None:
            raise failure


def _work() -> None:
    while True:
        kernel, arguments, done = _jobs.get()
        done.put(_attempt(kernel, arguments))


def _attempt(kernel: Kernel, arguments: Sequence[Any]) -> BaseException | None:
    try:
        kernel(*arguments)
    except BaseException as error:
        return error
    return None


def _forget_workers() -> None:
    """A forked process has none of its parent's threads, and may hold a copy of a taken lock."""
    global _jobs
    _jobs, _workers[:] = SimpleQueue(), []


os.register_at_fork(after_in_child=_forget_workers)
