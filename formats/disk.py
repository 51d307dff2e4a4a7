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
def explained(folder: Path) -> Iterator[None]:
    """What fails within because `folder`, or a file that the error names, cannot be written is a DiskFailure.

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
        raise _failure(fault, folder) from error


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
