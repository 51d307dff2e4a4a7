"""Names of the user's folders: distinct, readable, the same for one folder always, and never a scene's of ours.

`work/.names/NAME.json` says which folder NAME stands for. It is written when a folder is first run, whole and under a
lock, so that two runs at once never share a name.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
from pathlib import Path

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import atomic_write, parse_json
from chebsplat.pipelines import leases, store
from chebsplat.pipelines.scenes import folder_name, names

UNKNOWN = ""  # the owner of a name whose links were made by something else
LONGEST = 80  # bytes of a name; its settings follow in the folder's name


def record(name: str) -> Path:
    """The file that says which folder a name stands for."""
    return store.work() / ".names" / f"{name}.json"


def candidates(folder: Path) -> list[str]:
    """Names for a folder, the shortest first: its own, with its parent's, with a digest of its path."""
    short, longer = folder_name(folder)[:LONGEST], folder_name(folder, 1)
    mark = hashlib.sha256(os.fsencode(folder)).hexdigest()[:8]
    forms = [short, longer, f"{short[: LONGEST - 9]}-{mark}"]
    reserved = set(names("scenes"))
    return [
        name
        for name in forms
        if name not in reserved and not name.startswith(("study-", "basis-")) and len(name.encode()) <= LONGEST
    ] or [f"folder-{mark}"]


def owner(name: str) -> str | None:
    """The folder that a name stands for; None of a free one. Raises InputError if what says so is damaged."""
    file = record(name)
    if file.exists():
        remedy = "remove it: the next run of its folder writes it again"
        value = parse_json(file, remedy)
        if not isinstance(value, dict) or not isinstance(value.get("source"), str):
            raise InputError(f"{file} names no folder; {remedy}")
        return value["source"]
    links = [store.work() / name, *store.work().glob(f"{glob.escape(name)}@*")]
    made = [folder for folder in links if folder.is_dir() or folder.is_symlink()]
    return next(filter(None, map(recorded, made)), UNKNOWN) if made else None


def recorded(folder: Path) -> str:
    """The source of a scene that was run before names were kept: what its capture was read from."""
    try:
        path = json.loads((folder / "ingest/artifact.json").read_text())["config"]["source"]["path"]
    except (OSError, ValueError, KeyError, TypeError):
        return UNKNOWN
    return path if isinstance(path, str) else UNKNOWN


def name_of(folder: Path) -> str:
    """The name that a folder has, or that it would be given. Raises ConfigError if none is free."""
    possible = candidates(folder)
    owners = {name: owner(name) for name in possible}
    for wanted in (str(folder), None):
        for name in possible:
            if owners[name] == wanted:
                return name
    taken = record(possible[-1]).parent
    raise ConfigError(f"{folder}: {', '.join(possible)} stand for other folders ({taken}); chebsplat rm frees a name")


def claim(folder: Path) -> str:
    """The folder's name, from now on its own."""
    file = record("any")
    file.parent.mkdir(parents=True, exist_ok=True)
    with leases.held(store.lease(store.work(), "names")):
        name = name_of(folder)
        if not record(name).exists():
            atomic_write(record(name), json.dumps({"source": str(folder)}) + "\n")
    return name


def release(name: str) -> None:
    """Free a name that no links bear any more."""
    if not (store.work() / name).exists() and not any(store.work().glob(f"{glob.escape(name)}@*")):
        record(name).unlink(missing_ok=True)


def known(folder: Path) -> str | None:
    """The name that a folder has; None of one that was never run."""
    return next((name for name in candidates(folder) if owner(name) == str(folder)), None)
