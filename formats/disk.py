"""Disks that are full, over quota, read-only or not ours to write: one line, with the file and the bytes."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chebsplat.errors import ChebsplatError, DiskFailure, InputError

FULL = {getattr(errno, name) for name in ("ENOSPC", "EDQUOT") if hasattr(errno, name)}
CLOSED = {errno.EROFS, errno.EACCES, errno.EPERM}
REFUSALS = FULL | CLOSED
# What libraries say that hide the system's error behind their own.
WORDS = {"No space left on device": errno.ENOSPC, "Disk quota exceeded": errno.EDQUOT, "os error 28": errno.ENOSPC}
PROBE = 1 << 20  # bytes; of what has just failed, less may be missing


@contextmanager
def explained(folder: Path, passed: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """What fails within because `folder`, or a file that the error names, cannot be written is a DiskFailure.

    Args: passed: errors that are left as they are.
    Choices: after an error that says nothing of the disk (numpy, safetensors and torch have such), writing is tried.
    Raises: DiskFailure; InputError naming a file that may not be read.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, (ChebsplatError, *passed)):
            raise
        fault = _of_disk(error) or (None if isinstance(error, FileNotFoundError) else refusal(folder))
        if fault is None:
            raise
        raise _failure(fault, folder) from error


def check(folder: Path, words: str) -> None:
    """Raise DiskFailure if a disk takes no more, or if the last `words` of a program say so."""
    if fault := _of_disk(RuntimeError(words)) or refusal(folder):
        raise _failure(fault, folder)


def _of_disk(error: BaseException | None) -> OSError | None:
    """The disk's own error among those that led to this one."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno in REFUSALS:
            return error
        if number := next((number for words, number in WORDS.items() if words in str(error)), None):
            return OSError(number, os.strerror(number))
        error = error.__cause__ or error.__context__
    return None


def refusal(folder: Path) -> OSError | None:
    """The error with which a disk refuses to take a little more; None if it does not."""
    if not folder.is_dir():
        return None
    probe = folder / f".probe-{uuid.uuid4().hex}"
    try:
        probe.write_bytes(bytes(PROBE))
    except OSError as error:
        return error
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


def _failure(fault: OSError, folder: Path) -> ChebsplatError:
    file = Path(os.fsdecode(fault.filename)) if isinstance(fault.filename, str | bytes) else folder
    if fault.errno in CLOSED:
        if file.exists() and not os.access(file, os.R_OK):
            return InputError(f"{file} cannot be read ({fault.strerror}); allow it, or name another")
        return DiskFailure(f"{file} cannot be written ({fault.strerror}); make it writable, or choose another folder")
    there = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder == there else 0
    free = shutil.disk_usage(there).free
    return DiskFailure(
        f"{file} cannot be written ({fault.strerror}): more than {written:,} bytes are needed in {folder.parent}, "
        f"{free:,} are free beside those; make room and give the same command again"
    )
