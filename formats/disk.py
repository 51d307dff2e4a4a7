"""Disks that are full, over quota, read-only or not ours to write: one line, with the file and the bytes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chebsplat.errors import ChebsplatError, DiskFailure, InputError

CLOSED = {errno.EROFS, errno.EACCES, errno.EPERM}
REFUSALS = {errno.ENOSPC, errno.EDQUOT} | CLOSED


@contextmanager
def explained(folder: Path, scratch: bool = False) -> Iterator[None]:
    """Turn refusals of the disk within into a DiskFailure that names the error's file, or `folder`.

    Args: scratch: `folder` holds what is being written and nothing else; the message has its bytes.
    Raises: DiskFailure; InputError naming a file that may not be read.
    """
    try:
        yield
    except ChebsplatError:
        raise
    except Exception as error:
        fault: BaseException | None = error
        while fault is not None and not (isinstance(fault, OSError) and fault.errno in REFUSALS):
            fault = fault.__cause__
        if fault is None:
            raise
        raise _failure(fault, folder, scratch) from error


def _failure(fault: OSError, folder: Path, scratch: bool) -> ChebsplatError:
    file = Path(os.fsdecode(fault.filename)) if isinstance(fault.filename, str | bytes) else folder
    if fault.errno in CLOSED:
        if file.exists() and not os.access(file, os.R_OK):
            return InputError(f"{file} cannot be read ({fault.strerror}); allow it, or name another")
        return DiskFailure(f"{file} cannot be written ({fault.strerror}); make it writable, or choose another folder")
    there = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if scratch else 0
    needed = f"more than {written:,} bytes are needed in {folder.parent}, " if scratch else ""
    free = f"{shutil.disk_usage(there).free:,} are free{' beside those' if scratch else ''}"
    return DiskFailure(
        f"{file} cannot be written ({fault.strerror}): {needed}{free}; make room and give the same command again"
    )
