"""HEADs: the revisions of one basis that many processes extend, each a link `1`, `2`, ... to a finished artifact.

The HEAD is the highest number. It moves by creating the next link, which the file system grants to one process alone:
compare-and-swap, without a lock or a half-written file that a killed process could leave behind.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.files import sync

NUMBER = re.compile(r"[1-9][0-9]{0,8}")  # of a revision


def revisions(folder: Path) -> list[Path]:
    """Artifacts of all revisions, the oldest first; none for a folder that is not there.

    Raises: InputError naming a revision that is missing or whose artifact is, or a link that is out of order.
    """
    numbers = [name for name in (os.listdir(folder) if folder.is_dir() else []) if NUMBER.fullmatch(name)]
    links = [folder / str(number) for number in range(1, len(numbers) + 1)]
    for name in numbers:
        if folder / name not in links:
            raise InputError(
                f"{folder / name} follows no finished revision {int(name) - 1}: restore that, or delete the link"
            )
    for link in links:
        if not artifact.is_published(link):
            raise InputError(f"{link} is no finished revision: restore its artifact, or delete {folder} and begin anew")
        if link.resolve().name != (key := artifact.read_manifest(link).key):
            raise InputError(f"{link} leads to no folder that is called {key}, as its artifact is; link that")
    return [link.resolve() for link in links]


def advance(folder: Path, count: int, target: Path) -> bool:
    """Make `target` revision `count` + 1, if there are `count` revisions; False where another process has moved on.

    Raises: InputError if `target` is not a finished artifact.
    """
    artifact.read_manifest(target)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        os.symlink(os.path.relpath(target, folder.resolve()), folder / str(count + 1))
    except FileExistsError:
        return False
    sync(folder)
    return True


def extend(folder: Path, build: Callable[[Path | None], Path | None]) -> list[Path]:
    """Append a revision to a HEAD, however many processes do so at once; returns all revisions.

    Args: build: makes the artifact that follows the given one (None: the first), or returns None if that one already
          holds what is to be added. It is called again whenever another process was faster.
    Raises: InputError, and what `build` raises.
    """
    while True:
        chain = revisions(folder)
        made = build(chain[-1] if chain else None)
        if made is None or advance(folder, len(chain), made):
            return chain if made is None else [*chain, made]
