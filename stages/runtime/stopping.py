"""Ends of our processes: well, with a typed error, a crash, or by SIGINT, SIGTERM or SIGHUP.

A signal raises `Stopped` in the main thread, so that nothing half made is left; a loop that can
reach a better place within a moment defers it. A process that cannot react (compiling a kernel)
is killed by its run.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TextIO, cast

import click

from chebsplat.errors import ChebsplatError, DiskFailure, Stopped
from chebsplat.formats.files import OUTPUT, REFUSALS, explained

log = logging.getLogger("chebsplat")
SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
STREAMS = 2  # the highest number of a standard stream
PATIENCE = 2.5  # seconds from the request to the kill
KEPT = "what was finished is kept, and the same command goes on from there"


def exit_code(
    action: Callable[[], int | None],
    folder: Path,
    tell: Callable[[str], object] = log.error,
    raised: tuple[type[Exception], ...] = (),
) -> int:
    """Run a command's action; returns its code (None: 0), or that of the error that ends it.

    Args: folder: of a disk's error that names no file; tell: prints a typed error or a stop;
      raised: errors that are left to the caller, beside click's own.
    """
    try:
        with heeded(), explained(folder):
            return action() or 0
    except (ChebsplatError, Stopped) as error:
        tell(str(error))
        return error.exit_code
    except (click.ClickException, click.Abort, click.exceptions.Exit):
        raise
    except raised:
        raise
    except Exception:
        log.exception("crashed; nothing was published")
        return 1


class _Output:
    """Standard output whose write errors name it. The first is stored in `refusal`, since click
    silences errors; later output is dropped.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.refusal: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._named():
            return self._stream.write(text)

    def flush(self) -> None:
        with self._named():
            self._stream.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in REFUSALS:
                error.filename, self.refusal = OUTPUT, error
                with open(os.devnull, "w") as nowhere, suppress(OSError):
                    os.dup2(nowhere.fileno(), self._stream.fileno())
            raise


@contextmanager
def streams(tell: Callable[[str], object]) -> Iterator[None]:
    """Standard streams as a command needs them: closed ones lead nowhere, and not into the next
    file that is opened; an output that takes nothing is a DiskFailure that names it. Raises
    SystemExit.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= STREAMS:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    output = _Output(sys.stdout)
    try:
        with explained(Path()), redirect_stdout(cast(TextIO, output)):
            try:
                yield
            except SystemExit as stop:
                with suppress(BrokenPipeError):
                    output.flush()
                if output.refusal is None or stop.code == DiskFailure.exit_code:
                    raise
                raise output.refusal from None
    except DiskFailure as error:
        tell(str(error))
        sys.exit(error.exit_code)


class StopRequest:
    """A request that this process stop. `stop`: None until one comes, then the error to raise;
    `since`: when, by the monotonic clock.
    """

    def __init__(self) -> None:
        self.stop: Stopped | None = None
        self.since = 0.0
        self.deferred = False

    def heed(self, number: int, _frame: FrameType | None) -> None:
        """Handle a signal. Within PATIENCE of one a second does not break into the cleaning up
        after it; later it does, since a destructor may have lost the first.
        """
        now = time.monotonic()
        if self.stop is None or now - self.since > PATIENCE:
            self.stop = Stopped(number, f"stopped by {signal.Signals(number).name}; {KEPT}")
            self.since = now
            if not self.deferred:
                raise self.stop


_request: StopRequest | None = None


@contextmanager
def heeded() -> Iterator[None]:
    """Signals raise `Stopped` within; one that is ignored (nohup) stays so. The outermost rules.

    An error that a stop causes, as in an import that it interrupts, is raised as the stop, not as a
    crash; in a destructor, where nothing can be raised, it is silent.
    """
    global _request
    outermost = _request is None and threading.current_thread() is threading.main_thread()
    request, hook = _request or StopRequest(), sys.unraisablehook
    before = {number: signal.getsignal(number) for number in SIGNALS} if outermost else {}

    def unless_stopped(unraisable: Any) -> None:
        if request.stop is None:
            hook(unraisable)

    if outermost:
        _request, sys.unraisablehook = request, unless_stopped
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, request.heed)
    try:
        yield
    except Exception as error:
        if request.stop is not None:
            raise request.stop from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if outermost:
            _request, sys.unraisablehook = None, hook


@contextmanager
def deferred() -> Iterator[StopRequest]:
    """Defer `Stopped` to the end of the block, which looks at `stop` itself every few moments."""
    request = _request or StopRequest()
    request.deferred = True
    try:
        yield request
    finally:
        request.deferred = False
    if request.stop is not None:
        raise request.stop


def end_itself() -> None:
    """Ask this process to end, from another thread, and kill it if it does not react."""
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    time.sleep(PATIENCE)
    os._exit(128 + signal.SIGTERM)
