"""Leases: who is at work on what, told by files that any shared file system keeps right.

A lease is a folder of links `1`, `2`, ...; the newest says who holds it. A link is made at once, with what it says, and
for one process alone, on NFS too: no lock of the file system is needed. Whoever is done renames the file `N.beat` to
`N.over`; whoever is dead is followed by the next number. Whether a process of this machine lives is asked of the
system; one elsewhere lives as long as its beat moves by the clock of who looks, so that no two clocks are compared.
Numbers are never taken twice, which is why the files stay until `chebsplat clean-stale` sweeps them.

Choices: whoever is silent for EXPIRES seconds and was alive all the same works on beside its successor. Both publish
  the same artifact, whole; one is kept.
"""

from __future__ import annotations

import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

EVERY = 5.0  # seconds between beats
EXPIRES = 60.0  # seconds of silence after which a holder elsewhere counts as dead
LOOK = 0.1  # seconds between looks at a lease that is waited for


@cache
def here() -> str:
    """What tells the processes of this machine, as it has been started, from those of any other."""
    try:
        booted = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        # containers count processes apart; machines that were cloned while they ran have one boot
        return f"{socket.gethostname()}-{booted}-{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return f"{uuid.getnode():x}"


def started(pid: int) -> str:
    """When a process began, so that another one of its number is not taken for it; "": there is none."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] in "ZX" else fields[19]


@contextmanager
def held(folder: Path, wait: Callable[[str], object] = lambda _machine: None) -> Iterator[None]:
    """Hold the lease `folder` within the block, after whoever holds it; `wait` is told on which machine that is."""
    number, over = taken(folder, wait), threading.Event()
    beat = folder / f"{number}.beat"
    thread = threading.Thread(target=_beat, args=(beat, over), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with suppress(OSError):  # swept by someone who took us for dead
            os.rename(beat, beat.with_suffix(".over"))


def taken(folder: Path, wait: Callable[[str], object]) -> int:
    """The number under which this process holds the lease, when it does."""
    mine = f"{here()} {os.getpid()} {started(os.getpid())} {uuid.uuid4().hex} {socket.gethostname()}"
    newest, watch, told = 0, Watch(folder), False
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        newest = max(newest, newest_of(folder))  # a listing may be older than what we know
        if newest == 0 or not watch.is_alive(newest):
            try:
                os.symlink(mine, folder / f"{newest + 1}")
            except FileNotFoundError:  # swept meanwhile
                continue
            except FileExistsError:
                pass
            newest += 1
            if said(folder, newest) == mine:  # a server that was slow to answer may have made it nevertheless
                (folder / f"{newest}.beat").touch()
                return newest
            continue
        if not told:
            wait(said(folder, newest).rpartition(" ")[2])
            told = True
        time.sleep(LOOK)


def newest_of(folder: Path) -> int:
    """The newest number of a lease; 0: nobody has ever held it."""
    try:
        return max((int(name) for name in os.listdir(folder) if name.isdecimal()), default=0)
    except OSError:
        return 0


def said(folder: Path, number: int) -> str:
    """What a link says of its holder; "": it is not there."""
    try:
        return os.readlink(folder / f"{number}")
    except OSError:
        return ""


def holder(folder: Path) -> tuple[str, float] | None:
    """The machine of who seems to hold a lease, at one look, and for how many seconds, by the clock of the file system.
    None: nobody, or a process of this machine that is dead.
    """
    if not (number := newest_of(folder)) or not Watch(folder).is_alive(number):
        return None
    try:
        taken_at, beaten = (os.lstat(folder / name).st_mtime for name in (f"{number}", f"{number}.beat"))
    except OSError:  # it lets go just now
        return None
    return said(folder, number).rpartition(" ")[2], max(beaten - taken_at, 0.0)


def is_held(folder: Path) -> bool:
    """Whether someone holds a lease now. A holder elsewhere is watched until its beat moves, at most for EXPIRES."""
    watch = Watch(folder)
    while (number := newest_of(folder)) and watch.is_alive(number):
        if watch.sure:
            return True
        time.sleep(EVERY / 5)
    return False


class Watch:
    """Looks at the holders of one lease, again and again. `sure`: the last look has seen a sign of life."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.sure = False
        self._seen: tuple[int, int | None] | None = None
        self._since = 0.0

    def is_alive(self, number: int) -> bool:
        """Whether the holder of a number is not known to be done or dead."""
        self.sure = False
        if (self.folder / f"{number}.over").exists():
            return False
        who = said(self.folder, number).split(" ")
        if len(who) == 5 and who[0] == here() and who[2]:
            self.sure = started(int(who[1])) == who[2]
            return self.sure
        seen = number, _moved(self.folder / f"{number}.beat")
        if seen != self._seen:
            self.sure = self._seen is not None and self._seen[0] == number
            self._seen, self._since = seen, time.monotonic()
        return time.monotonic() - self._since < EXPIRES


def _moved(beat: Path) -> int | None:
    """The beat's time, of which only changes matter. Opened first: NFS then asks the server, not what it remembers."""
    try:
        handle = os.open(beat, os.O_RDONLY)
    except OSError:
        return None
    try:
        return os.fstat(handle).st_mtime_ns
    finally:
        os.close(handle)


def _beat(beat: Path, over: threading.Event) -> None:
    """Move a beat until it is over; a file system that does not answer for a while is asked again."""
    while not over.wait(EVERY):
        with suppress(OSError):
            os.utime(beat)
