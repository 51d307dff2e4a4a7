"""Names of the user's folders: readable, unique, and the same for a folder every time.

A name ends with four digits of a digest of the folder's path. `work/.folders/NAME` links to the
folder that has run under a name: a second folder with the same name is refused.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from chebsplat.errors import ConfigError
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.scenes import folder_name

LONGEST = 80  # bytes of a name; its settings follow in the name of the folder of links


def record(name: str) -> Path:
    """The link to the folder that has run under a name."""
    return store.work() / ".folders" / name


def owner(name: str) -> str | None:
    """The folder that has run under a name; None: none has."""
    with suppress(OSError):
        return os.readlink(record(name))
    return None


def name_of(folder: Path) -> str:
    """A folder's name. Raises ConfigError if another one has run under it."""
    digits = hashlib.sha256(os.fsencode(folder)).hexdigest()[:4]
    short = folder_name(folder).encode()[: LONGEST - len("folder--1a2b")].decode(errors="ignore")
    ours = short.startswith("study-")  # the prefix of studies' links
    name = f"folder-{short}-{digits}" if ours else f"{short}-{digits}"
    if (other := owner(name)) not in (None, str(folder)):
        raise ConfigError(
            f"{folder}: {name} stands for {other}; rename one, or remove {record(name)}"
        )
    return name


def claim(folder: Path) -> str:
    """The folder's name, from now on its own."""
    file = record(name_of(folder))
    file.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        file.symlink_to(folder)
    return name_of(folder)
