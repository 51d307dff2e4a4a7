"""Names of the user's folders: readable, the same for one folder always, and never another's or a scene's of ours.

A name ends with four digits of a digest of where its folder lies. `work/.folders/NAME` is a link to the folder that has
run under a name: of two with one digest, the other is refused.
"""

from __future__ import annotations

import glob
import hashlib
import os
from contextlib import suppress
from pathlib import Path

from chebsplat.errors import ConfigError
from chebsplat.pipelines import store
from chebsplat.pipelines.scenes import folder_name

LONGEST = 80  # bytes of a name; its settings follow in the folder's name


def owner(name: str) -> str | None:
    """The folder that has run under a name."""
    with suppress(OSError):
        return os.readlink(_record(name))
    return None


def name_of(folder: Path) -> str:
    """A folder's name. Raises ConfigError if another one has run under it."""
    digits = hashlib.sha256(os.fsencode(folder)).hexdigest()[:4]
    short = folder_name(folder)
    short = f"folder-{short}" if short.startswith(("study-", "basis-")) else short  # studies and HEADs lie beside it
    name = f"{short.encode()[: LONGEST - 5].decode(errors='ignore')}-{digits}"
    if (other := owner(name)) not in (None, str(folder)):
        raise ConfigError(f"{folder}: {name} stands for {other}; rename one, or free the name: chebsplat rm {name}")
    return name


def claim(folder: Path) -> str:
    """The folder's name, from now on its own."""
    name = name_of(folder)
    _record(name).parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        _record(name).symlink_to(folder)
    return name_of(folder)


def release(name: str) -> None:
    """Free a name that no links bear any more."""
    if not (store.work() / name).exists() and not any(store.work().glob(f"{glob.escape(name)}@*")):
        _record(name).unlink(missing_ok=True)


def _record(name: str) -> Path:
    return store.work() / ".folders" / name
