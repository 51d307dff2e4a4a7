"""How our processes end when they are asked to: by SIGINT, SIGTERM or SIGHUP, or because their run has ended.

A signal raises `Stopped` in the main thread, so that nothing half made is left; a loop that can reach a better place
within a moment defers it. A job of a run has a pipe for its standard input, the lifeline, whose other end only the run
holds: however the run ends, the pipe does, and the job stops. Whoever is not done within a few seconds (a kernel is
being compiled) is ended from a thread.
"""

from __future__ import annotations

import os
import shutil
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from chebsplat.errors import Stopped

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
LIFELINE = "CHEBSPLAT_LIFELINE"  # the number of the pipe; of another pipe or file nothing is to be concluded
SECONDS = 2.5  # from being asked to the end of a job
PATIENCE = SECONDS + 0.7  # of a run with its jobs, before it kills them


class Asked:
    """What this process has been asked. `stop`: not at all, or what is raised."""

    def __init__(self) -> None:
        self.seconds = PATIENCE + 0.8  # from the signal to the end, whatever happens
        self.reason = ""
        self.stop: Stopped | None = None
        self.deferred = False
        self.half: set[Path] = set()  # folders that are worth nothing if the process ends now

    def heed(self, number: int, _frame: FrameType | None = None) -> None:
        """The signals' handler. Whoever is ending already is left to it."""
        if self.stop is None:
            self.stop = self.stop_by(number)
            if not self.deferred:
                raise self.stop

    def stop_by(self, number: int) -> Stopped:
        return Stopped(number, self.reason or f"stopped by {signal.Signals(number).name}")

    def insist(self, wakened: int, over: threading.Event) -> None:
        """A thread's work: once asked, leave in time, whether the main thread has come to hear of it or not.

        wakened: file descriptor where signals arrive.
        """
        while (data := os.read(wakened, 1)) and data[0] not in SIGNALS:
            pass
        until = time.monotonic() + self.seconds
        while data and not over.wait(0.1):
            if time.monotonic() > until:
                self.leave(self.stop or self.stop_by(data[0]))
            if self.stop is None:  # the signal woke this thread, and the main one may sleep on in a system call
                signal.pthread_kill(threading.main_thread().ident or 0, data[0])

    def leave(self, stop: Stopped) -> None:
        """End the process at once, without what is half made."""
        for folder in list(self.half):
            shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError, ValueError):
            print(stop, file=sys.stderr, flush=True)
        os._exit(stop.exit_code)

    def ignored(self, hook: Callable[[Any], object]) -> Callable[[Any], None]:
        """A hook for what Python has to ignore: in a destructor a stop is none, and no fault either."""

        def unless_stopped(unraisable: Any) -> None:
            if self.stop is None:
                hook(unraisable)

        return unless_stopped


_asked: Asked | None = None


@contextmanager
def _unbroken() -> Iterator[None]:
    """What breaks because a stop has come, an import that it fell into, is the stop and no crash."""
    try:
        yield
    except Exception as error:
        if _asked is not None and _asked.stop is not None:
            raise _asked.stop from error
        raise


@contextmanager
def heeded() -> Iterator[None]:
    """Signals raise `Stopped` within; one that is ignored (nohup) stays so. Of nested ones the outermost rules."""
    global _asked
    if _asked is not None or threading.current_thread() is not threading.main_thread():
        with _unbroken():
            yield
        return
    _asked, over, (reader, writer) = Asked(), threading.Event(), os.pipe()
    os.set_blocking(writer, False)
    thread = threading.Thread(target=_asked.insist, args=(reader, over), daemon=True)
    thread.start()
    earlier = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _asked.heed)
    hook, sys.unraisablehook = sys.unraisablehook, _asked.ignored(sys.unraisablehook)
    try:
        with _unbroken():
            yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(earlier)
        _asked = None
        over.set()
        os.close(writer)
        thread.join()
        os.close(reader)


@contextmanager
def deferred() -> Iterator[Asked]:
    """Nothing is raised within, but at the end: the block looks at `stop` itself, and comes to one within a moment."""
    asked = _asked or Asked()
    asked.deferred = True
    try:
        yield asked
    finally:
        asked.deferred = False
    if asked.stop is not None:
        raise asked.stop


@contextmanager
def half_made(folder: Path) -> Iterator[None]:
    """A folder that goes with the process if that has to end within."""
    half = set() if _asked is None else _asked.half
    half.add(folder)
    try:
        yield
    finally:
        half.discard(folder)


def watch_lifeline() -> None:
    """Stop this process, a job, when its run ends. Does nothing without a lifeline (on another machine, by hand)."""
    state = os.fstat(0)
    if stat.S_ISFIFO(state.st_mode) and os.environ.get(LIFELINE) == str(state.st_ino):
        if _asked is not None:
            _asked.seconds = SECONDS
        threading.Thread(target=_watch, daemon=True).start()


def stop(reason: str) -> None:
    """Ask this process to end, from any of its threads."""
    if _asked is not None:
        _asked.reason = reason
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)


def _watch() -> None:
    while os.read(0, 1):
        pass
    stop("its run has ended")
