"""Leases: who works on what, recorded in files that work on any shared file system.

A lease is filelock's: a file that only one process can create, which names its holder, is touched
every few seconds, and is removed when its holder is done. A holder on this machine is checked by
its process; one elsewhere counts as dead when its file has not changed for EXPIRES seconds by the
clock of the reader. File locks are not needed.

Choices: a holder that was silent for EXPIRES seconds but alive works on beside its successor. Both
  publish the same artifact, whole; one of them stays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import SoftFileLease, Timeout

EVERY = 5.0  # seconds between heartbeats
EXPIRES = 60.0  # seconds of silence after which a holder elsewhere counts as dead


@contextmanager
def hold(path: Path, wait: Callable[[str], object] = lambda _machine: None) -> Iterator[None]:
    """Hold the lease `path` within the block; where it is taken, `wait` gets its machine's name."""
    lease, seconds = _lease(path), 0.0
    while True:
        try:
            acquired = lease.acquire(timeout=seconds)
            break
        except Timeout:
            if seconds == 0:
                wait(_machine(lease) or "this machine")
            elif lease.owner is None:  # its creator was killed before it wrote its name
                lease.force_break()
            seconds = EXPIRES
    with acquired:
        yield


def holder(path: Path) -> str | None:
    """The machine of a lease's likely holder; None: nobody, or a dead process of this machine."""
    lease = _lease(path)
    if machine := _machine(lease):
        try:
            lease.acquire(timeout=0).lock.release()
        except Timeout:
            return machine
    return None


def _lease(path: Path) -> SoftFileLease:
    return SoftFileLease(path, lease_duration=EXPIRES, heartbeat_interval=EVERY)


def _machine(lease: SoftFileLease) -> str | None:
    owner = lease.owner
    return owner.hostname.partition("?")[0] if owner else None  # the id of a container follows
