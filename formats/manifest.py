"""`artifact.json`: what an artifact says of itself, held to rules before anything is done with it.

A key becomes a folder's name and a member's name a path: neither may lead anywhere else.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.files import parse_json

MANIFEST = "artifact.json"
KEY = re.compile(r"[0-9a-f]{16}")
DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass
class Manifest:
    """What `artifact.json` holds. `files` maps relative POSIX paths to {"sha256", "bytes"}."""

    schema: str  # "chebsplat.<name>/<n>"
    key: str
    stage: str
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)  # role -> {"key", "schema"}
    config: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)  # what the stage found, chose and left out
    code: dict[str, Any] = field(default_factory=dict)  # {"hash", "commit", "dirty"}
    versions: dict[str, str] = field(default_factory=dict)
    device: str = "cpu"
    threads: int = 1
    seconds: float = 0.0
    files: dict[str, dict[str, Any]] = field(default_factory=dict)


def is_key(value: object) -> bool:
    """Whether a value names an artifact: 16 hexadecimal digits, and nothing that could lead out of a folder."""
    return isinstance(value, str) and KEY.fullmatch(value) is not None


def is_member(name: str) -> bool:
    """Whether a name stays below the folder that it is relative to, and is spelt in one way only."""
    path = PurePosixPath(name)
    inside = bool(path.parts) and not path.is_absolute() and ".." not in path.parts
    return inside and str(path) == name and "\0" not in name


def _is_size(value: object) -> bool:
    return type(value) is int and value >= 0


def _is_member_table(value: Any) -> bool:
    return isinstance(value, dict) and all(
        is_member(name)
        and isinstance(entry, dict)
        and _is_size(entry.get("bytes"))
        and isinstance(entry.get("sha256"), str)
        and DIGEST.fullmatch(entry["sha256"]) is not None
        for name, entry in value.items()
    )


def _is_input_table(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(entry, dict) and is_key(entry.get("key")) and isinstance(entry.get("schema"), str)
        for entry in value.values()
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_table(value: object) -> bool:
    return isinstance(value, dict)


RULES = {
    "schema": ("a text", _is_text),
    "key": ("16 hexadecimal digits", is_key),
    "stage": ("a text", _is_text),
    "inputs": ("roles with a key of 16 hexadecimal digits and a schema each", _is_input_table),
    "config": ("a table", _is_table),
    "seed": ("a whole number", lambda v: v is None or type(v) is int),
    "facts": ("a table", _is_table),
    "code": ("a table", _is_table),
    "versions": ("a table", _is_table),
    "device": ("a text", _is_text),
    "threads": ("a whole number", _is_size),
    "seconds": ("a number", lambda v: type(v) in (int, float) and math.isfinite(v)),
    "files": ("names below the artifact's folder with bytes and sha256 each", _is_member_table),
}
NEEDED = {"schema", "key", "stage"}


def remedy_of(path: Path) -> str:
    """What a message advises about a damaged artifact."""
    return f"delete {path} and run its stage again"


def parse_manifest(path: Path) -> Manifest:
    """The manifest of the artifact `path`, whose members are not looked at. Raises InputError naming the file."""
    file = path / MANIFEST
    document = parse_json(file, remedy_of(path))
    if not isinstance(document, dict) or not NEEDED <= document.keys() <= RULES.keys():
        raise InputError(f"{file} is damaged: it does not say what a manifest says; {remedy_of(path)}")
    manifest = Manifest(**document)
    for name, (wanted, holds) in RULES.items():
        if not holds(getattr(manifest, name)):
            raise InputError(f"{file} is damaged: {name} is not {wanted}; {remedy_of(path)}")
    return manifest
