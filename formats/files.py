"""Files: others' read with checks of type, size and syntax, ours written atomically.

Every reader of such a file goes through here, so that a pipe, a device, a folder, a file of
gigabytes, bytes that are no text and a document nested a thousand levels deep are refused at once,
in the same words everywhere. A disk that is full, over quota or read-only is reported in one line.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import stat
import tomllib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from chebsplat.errors import ChebsplatError, DiskFailure, InputError

# bytes of text, as a transforms.json of 20,000 frames; parsed JSON takes up to 25 times the memory
LARGEST = 32 << 20
LARGEST_TOML = 1 << 20  # tomllib reads about 2 MB a second
RESTORE = "restore the file"
# tomllib takes quadratic time over a dotted key; none of ours has more than four parts
ENDLESS_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){64}""")
SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
CLOSED = {errno.EROFS, errno.EACCES, errno.EPERM}
REFUSALS = {errno.ENOSPC, errno.EDQUOT} | CLOSED
# the name of the file in an error of writing it (`stages.runtime.stopping.streams`)
OUTPUT = "standard output"


def regular(
    path: Path, remedy: str = RESTORE, error: type[ChebsplatError] = InputError
) -> os.stat_result:
    """Size and time of a regular file, links followed; anything else would block, or never end."""
    try:
        state = os.stat(path)
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}") from None
    except (OSError, ValueError) as fault:  # a looping link, a name too long, a null byte in it
        raise error(f"{path}: {getattr(fault, 'strerror', None) or fault}; {remedy}") from None
    if not stat.S_ISREG(state.st_mode):
        kind = "a folder" if stat.S_ISDIR(state.st_mode) else "a pipe, a socket or a device"
        raise error(f"{path} is {kind}, not a file; {remedy}")
    return state


def read_text(
    path: Path,
    remedy: str = RESTORE,
    error: type[ChebsplatError] = InputError,
    largest: int = LARGEST,
) -> str:
    """The text of a regular UTF-8 file. Raises `error` naming the file and the remedy."""
    if (size := regular(path, remedy, error).st_size) > largest:
        raise error(f"{path} has {size} bytes, more than the {largest} that are read; {remedy}")
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as fault:
        raise error(f"{path}: {fault.strerror}; {remedy}") from None
    except UnicodeDecodeError as fault:
        raise error(f"{path} is no UTF-8 text (byte {fault.start}); {remedy}") from None


def parse_json(
    path: Path,
    remedy: str = RESTORE,
    error: type[ChebsplatError] = InputError,
    finite: bool = False,
) -> Any:
    """The value in a JSON file; `finite`: nan and infinities are refused. Raises `error`."""
    text = read_text(path, remedy, error)
    try:
        strict: dict[str, Any] = (
            {"parse_constant": _finite, "parse_float": _finite} if finite else {}
        )
        value = json.loads(text, object_pairs_hook=_once, **strict)
        # a lone surrogate can be neither printed nor hashed nor written
        if SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()
    except RecursionError:
        raise error(f"{path} is nested too deeply; {remedy}") from None
    except ValueError as fault:
        raise error(f"{path} does not parse ({fault}); {remedy}") from None
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object of different keys: of two values of one key neither may be the intended one."""
    value = dict(pairs)
    if len(value) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{twice[:80]!r} is given twice")
    return value


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]} is no finite number")
    return value


def parse_toml(
    path: Path, remedy: str = RESTORE, error: type[ChebsplatError] = InputError
) -> dict[str, Any]:
    """The table in a TOML file. Raises `error`."""
    text = read_text(path, remedy, error, LARGEST_TOML)
    try:
        if ENDLESS_KEY.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except RecursionError:
        raise error(f"{path} is nested too deeply; {remedy}") from None
    except ValueError as fault:
        raise error(f"{path} does not parse ({fault}); {remedy}") from None


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to `path` when the block ends without an error.

    The file is there whole or not at all, whatever happens to the machine. A block that fails
    leaves what stood there before. The temporary name keeps the ending, by which some libraries
    choose a format.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".tmp-{os.getpid()}-{path.name}")
    try:
        yield temporary
        sync(temporary)
        os.replace(temporary, path)
    finally:
        with suppress(OSError):  # the disk has just failed
            temporary.unlink(missing_ok=True)
    sync(path.parent)


def atomic_write(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all; text as UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def sync(path: Path) -> None:
    """Make a file's bytes, or a folder's entries, outlive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def explained(folder: Path, scratch: bool = False) -> Iterator[None]:
    """Turn the disk's refusals into a DiskFailure that names the error's file, or `folder`.

    Args: scratch: `folder` only holds the files being written; the message gives their bytes.
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
    if fault.filename == OUTPUT:
        return DiskFailure(
            f"{OUTPUT} cannot be written ({fault.strerror}); make room where it goes, or send it "
            "elsewhere"
        )
    file = Path(os.fsdecode(fault.filename)) if isinstance(fault.filename, str | bytes) else folder
    if fault.errno in CLOSED:
        if file.exists() and not os.access(file, os.R_OK):
            return InputError(
                f"{file} cannot be read ({fault.strerror}); allow it, or name another"
            )
        return DiskFailure(
            f"{file} cannot be written ({fault.strerror}); make it writable, or "
            "choose another folder"
        )
    there = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    disk, free = os.statvfs(there), shutil.disk_usage(there).free
    written = (
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if scratch else 0
    )
    if fault.errno == errno.EDQUOT:
        why = f"your quota is used up, though {free:,} bytes are free; remove files of yours"
    elif disk.f_files and not disk.f_favail:
        why = f"{there} holds as many files as it can; remove some, however small,"
    elif written:
        why = (
            f"more than {written:,} bytes are needed in {folder.parent}, {free:,} are free "
            "beside those; make room"
        )
    else:
        why = f"{free:,} bytes are free in {there}, and more are needed; make room"
    return DiskFailure(
        f"{file} cannot be written ({fault.strerror}): {why} and give the same command again"
    )
