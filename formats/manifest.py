"""`artifact.json`, read and checked before any path or key in it is used.

A key becomes a folder's name and a member's name a path: neither may lead anywhere else.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.files import parse_json

MANIFEST = "artifact.json"
KEY = re.compile(r"[0-9a-f]{16}")


@dataclass
class Manifest:
    """The contents of `artifact.json`. `files`: relative POSIX paths to {"sha256", "bytes"}."""

    schema: str  # "chebsplat.<name>/<n>"
    key: str
    stage: str
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)  # role -> {"key", "schema"}
    config: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)  # of the stage: figures, choices, omissions
    code: dict[str, Any] = field(default_factory=dict)  # {"hash", "commit", "dirty"}
    versions: dict[str, str] = field(default_factory=dict)
    device: str = "cpu"
    threads: int = 1
    seconds: float = 0.0  # of all its processes
    # see `stages.runtime.machine.Stopwatch.processes`
    processes: list[dict[str, Any]] = field(default_factory=list)
    files: dict[str, dict[str, Any]] = field(default_factory=dict)


def measured_on(manifest: Manifest) -> str:
    """The machines, each with its threads, that an artifact's seconds were measured on; seconds
    compare where these are the same words.
    """
    threads = [f"{of['threads']} thread{'s' * (of['threads'] > 1)}" for of in manifest.processes]
    processors = [
        ", ".join(filter(None, (of["gpu"], of["processor"]))) for of in manifest.processes
    ]
    machines = dict.fromkeys(", ".join(words) for words in zip(processors, threads, strict=True))
    return " and ".join(machines) or "a machine that was not recorded"


def is_key(value: object) -> bool:
    """True for an artifact's key: 16 hexadecimal digits, so that it cannot lead out of a folder."""
    return isinstance(value, str) and KEY.fullmatch(value) is not None


def is_member(name: str) -> bool:
    """True for a path that stays below its folder and is spelt in its only normal form."""
    path = PurePosixPath(name)
    inside = bool(path.parts) and not path.is_absolute() and ".." not in path.parts
    return inside and str(path) == name and "\0" not in name


def remedy_of(path: Path) -> str:
    """The advice of messages about a damaged artifact."""
    return f"delete {path} and run its stage again"


def parse_manifest(path: Path) -> Manifest:
    """The manifest of the artifact `path`, its members not looked at.

    Raises:  InputError naming the file.
    Choices: only values that become paths are checked; nothing but our own code writes the rest.
    """
    file = path / MANIFEST
    document = parse_json(file, remedy_of(path))
    try:
        manifest = Manifest(**document)
        bad = [name for name, sound in _RULES.items() if not sound(getattr(manifest, name))]
    except (TypeError, AttributeError, KeyError) as error:
        bad = [str(error)]
    if bad:
        raise InputError(
            f"{file} is damaged: {bad[0]} is not what `publish` writes; {remedy_of(path)}"
        )
    return manifest


_RULES: dict[str, Callable[[Any], bool]] = {
    "key": is_key,
    "inputs": lambda inputs: all(is_key(entry["key"]) for entry in inputs.values()),
    "files": lambda files: all(
        is_member(name) and {"sha256", "bytes"} <= entry.keys() for name, entry in files.items()
    ),
}
