"""Leases: who is at work on what, told by a file that any shared file system keeps right.

A lease is filelock's: a file that only one process can make, which says who that is, is touched
every few seconds, and goes when its holder is done. Whether a process of this machine lives is
asked of the system; one elsewhere is dead when its file has not moved for long by the clock of who
looks. No lock of the file system is needed.

Choices: whoever is silent for EXPIRES seconds and was alive all the same works on beside its
  successor. Both publish the same artifact, whole; one is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import SoftFileLease, Timeout

EVERY = 5.0  # seconds between signs of life
EXPIRES = 60.0  # seconds of silence after which a holder elsewhere counts as dead


@contextmanager
def held(path: Path, wait: Callable[[str], object] = lambda _machine: None) -> Iterator[None]:
    """Hold the lease `path` within, after whoever holds it; `wait` is told on which machine."""
    lease, seconds = _lease(path), 0.0
    while True:
        try:
            taken = lease.acquire(timeout=seconds)
            break
        except Timeout:
            if seconds == 0:
                wait(_machine(lease) or "this machine")
            elif lease.owner is None:  # whoever made it was killed before it could say who it is
                lease.force_break()
            seconds = EXPIRES
    with taken:
        yield


def holder(path: Path) -> str | None:
    """The machine of who seems to hold a lease; None: nobody, or a dead process of this machine."""
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
    return owner.hostname.partition("?")[0] if owner else None  # a container's number follows
