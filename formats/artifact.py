"""Artifacts on disk: published whole or not at all, described by a manifest, verified on reading.

An artifact is a directory holding `artifact.json` and the files it lists. `publish` writes into a hidden
sibling, puts the manifest last, and renames: a reader sees a finished artifact or none.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError

MANIFEST = "artifact.json"


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


def sha256_file(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def is_published(path: Path) -> bool:
    return (path / MANIFEST).is_file()


@contextmanager
def publish(out: Path, manifest: Manifest) -> Iterator[Path]:
    """Yield a scratch directory that becomes `out`, whole, when the block ends without an error.

    `manifest` may be completed inside the block (facts, seconds); its file table is filled in here.
    If `out` was published meanwhile by a twin, the twin's artifact is kept and ours is discarded.
    Raises: InputError if `out` exists and is not an artifact (nothing of the user's is ever overwritten).
    """
    out = Path(out)
    tmp = out.parent / f".tmp-{out.name}-{os.getpid()}"
    if tmp.exists():
        shutil.rmtree(tmp)
    tmp.mkdir(parents=True)
    try:
        yield tmp
        if not is_published(out):
            manifest.files = _file_table(tmp)
            _write_synced(tmp / MANIFEST, json.dumps(asdict(manifest), indent=1, sort_keys=True) + "\n")
            _settle_tree(tmp)
            try:
                os.rename(tmp, out)
            except OSError:
                if not is_published(out):
                    raise InputError(f"{out} exists and is not an artifact; choose another --out") from None
            sync_directory(out.parent)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)


def read_manifest(path: Path, schema: str | None = None) -> Manifest:
    """The manifest of a published artifact, with every listed file checked for presence and size.

    Raises: InputError naming the damaged or missing file and the remedy.
    """
    path = Path(path)
    file = path / MANIFEST
    if not file.is_file():
        raise InputError(f"{file} is missing: not a finished artifact; run the stage that makes it again")
    try:
        manifest = Manifest(**json.loads(file.read_text()))
        entries = {name: int(entry["bytes"]) for name, entry in manifest.files.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{file} is damaged ({error}); {remedy(path)}") from None
    if schema is not None and manifest.schema != schema:
        raise InputError(f"{file} has schema {manifest.schema}, expected {schema}; pass the right artifact")
    for name, size in entries.items():
        member = path / name
        if not member.is_file():
            raise InputError(f"{member} is missing; {remedy(path)}")
        if member.stat().st_size != size:
            raise InputError(f"{member} has {member.stat().st_size} bytes, expected {size}; {remedy(path)}")
    return manifest


def verify(path: Path, schema: str | None = None) -> Manifest:
    """`read_manifest`, and every digest recomputed and every unlisted file reported."""
    path = Path(path)
    manifest = read_manifest(path, schema)
    for name in manifest.files:
        checked(path, manifest, name)
    extra = sorted(set(_file_table(path, hashed=False)) - set(manifest.files) - {MANIFEST})
    if extra:
        raise InputError(f"{path / extra[0]} is not listed in {MANIFEST} ({len(extra)} such); {remedy(path)}")
    return manifest


def checked(path: Path, manifest: Manifest, name: str) -> Path:
    """Path of one listed file after comparing its digest. Raises InputError if it differs."""
    entry = manifest.files.get(name)
    if entry is None:
        raise InputError(f"{path / name} is not part of this {manifest.schema} artifact; {remedy(path)}")
    if sha256_file(path / name) != entry["sha256"]:
        raise InputError(f"{path / name} does not match its sha256; {remedy(path)}")
    return path / name


def remedy(path: Path) -> str:
    return f"delete {path} and run its stage again"


def _file_table(root: Path, hashed: bool = True) -> dict[str, dict[str, Any]]:
    members = sorted(p for p in root.rglob("*") if p.is_file())
    return {
        p.relative_to(root).as_posix(): (
            {"sha256": sha256_file(p), "bytes": p.stat().st_size} if hashed else {"bytes": p.stat().st_size}
        )
        for p in members
    }


def _write_synced(path: Path, text: str) -> None:
    with path.open("w") as handle:
        handle.write(text)
        handle.flush()
        os.fsync(handle.fileno())


def _settle_tree(root: Path) -> None:
    """Make files outlive a power cut, and as readable as the user's umask has made their folder: some writers give a
    file to its owner alone.
    """
    mode = root.stat().st_mode & 0o666
    for path in root.rglob("*"):
        if path.is_file():
            with path.open("rb") as handle:
                os.fchmod(handle.fileno(), mode)
                os.fsync(handle.fileno())
    sync_directory(root)


def sync_directory(path: Path) -> None:
    """Make its entries outlive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def digest(value: Mapping[str, Any]) -> str:
    """sha256 (first 16 hex digits) of a JSON-able mapping in canonical form."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def discard(path: Path) -> None:
    """Remove an artifact or a scratch directory; the manifest goes first, so that no half artifact looks whole.

    Raises: InputError if `path` is a directory that is neither.
    """
    path = Path(path)
    if not path.exists():
        return
    if not (is_published(path) or path.name.startswith((".part-", ".tmp-"))):
        raise InputError(f"{path} exists and is not an artifact; nothing was removed")
    (path / MANIFEST).unlink(missing_ok=True)
    shutil.rmtree(path)
