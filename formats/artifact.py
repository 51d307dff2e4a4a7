"""Artifacts on disk: published whole or not at all, described by a manifest, verified on reading.

An artifact is a directory holding `artifact.json` and the files it lists. `publish` writes into a
hidden sibling, puts the manifest last, and renames: a reader sees a finished artifact or none.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import REFUSALS, explained, parse_json, sync
from chebsplat.formats.manifest import MANIFEST, Manifest, parse_manifest, remedy_of


def sha256_file(path: Path) -> str:
    """sha256 of a file's bytes, 64 hexadecimal digits."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def is_published(path: Path) -> bool:
    """True where a folder holds a manifest: `publish` has ended there."""
    return os.path.isfile(path / MANIFEST)


def copy(path: Path, out: Path, manifest: Manifest) -> None:
    """Publish the artifact `path`, whose manifest was read, at `out` as well.

    Raises: InputError if it has changed.
    """
    expected = manifest.files
    with publish(out, manifest) as tmp:
        for name in expected:
            (tmp / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path / name, tmp / name)
        changed = [name for name, file in _members(tmp).items() if _entry(file) != expected[name]]
        if changed:
            raise InputError(f"{path / changed[0]} has changed while it was copied; run again")


def is_whole(path: Path, schema: str | None = None) -> bool:
    """Published, and every member there in its size; `verify` recomputes digests too."""
    try:
        read_manifest(path, schema)
    except InputError:
        return False
    return True


@contextmanager
def publish(out: Path, manifest: Manifest, force: bool = False) -> Iterator[Path]:
    """Yield a scratch directory that becomes `out`, whole, when the block ends without an error.

    `manifest` may be completed inside the block (facts, seconds); its file table is filled in here.
    A whole artifact at `out`, as of another run that was faster, stays and ours is discarded,
    unless `force` is set. Nothing at `out` is touched before the end of the block.
    Raises: InputError as `check_place`; ConfigError if `out` cannot be made; DiskFailure if the
      disk is full.
    """
    out = Path(out)
    tmp = out.parent / f".tmp-{out.name}-{os.getpid()}"
    try:
        with explained(tmp, scratch=True):
            _make(tmp, out)
            yield tmp
            if force or not is_whole(out, manifest.schema):
                manifest.files = _settle(tmp)
                (tmp / MANIFEST).write_text(
                    json.dumps(asdict(manifest), indent=1, sort_keys=True) + "\n"
                )
                sync(tmp / MANIFEST)
                sync(tmp)
                _put(tmp, out, manifest, force)
                sync(out.parent)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)


def _make(tmp: Path, out: Path) -> None:
    try:
        if tmp.exists():
            shutil.rmtree(tmp)
        tmp.mkdir(parents=True)
    except OSError as error:
        if error.errno in REFUSALS:
            raise
        raise ConfigError(
            f"{out} cannot be written ({error.strerror}); choose another --out"
        ) from None


def _put(tmp: Path, out: Path, manifest: Manifest, force: bool) -> None:
    """Rename `tmp` to `out`, and before it away what `check_place` lets it replace."""
    replaced = tmp.with_name(f".tmp-{out.name}-old-{os.getpid()}")
    try:
        os.rename(tmp, out)
    except OSError:
        if not force and is_whole(out, manifest.schema):
            return  # another run was faster
        check_place(out, manifest.schema, manifest.key, force)
        os.rename(out, replaced)
        try:
            os.rename(tmp, out)
        except OSError:
            if not is_whole(out, manifest.schema):
                raise
    finally:
        shutil.rmtree(replaced, ignore_errors=True)


def check_place(out: Path, schema: str, key: str, force: bool = False) -> None:
    """Refuse `out` for an artifact unless nothing whole stands there, or `force` may replace it.

    Choices: a folder named by the artifact's key may be replaced, whatever a crash left in it.
      Elsewhere only an artifact of the same schema may, by `force`, and without unlisted files.
    Raises: InputError naming the obstacle; nothing is removed.
    """
    if os.path.islink(out):
        raise InputError(
            f"{out} is a link to {os.readlink(out)}: nothing was replaced; name "
            "that, or another --out"
        )
    if not os.path.lexists(out) or (
        os.path.isdir(out) and (out.name == key or not os.listdir(out))
    ):
        return
    if not is_published(out):
        raise InputError(
            f"{out} exists and is not an artifact: nothing was replaced; choose another --out"
        )
    try:
        standing = parse_manifest(out)
    except InputError:  # it may be the user's: no advice to delete it
        raise InputError(
            f"{out / MANIFEST} is no manifest: nothing was replaced; choose another --out"
        ) from None
    if standing.schema != schema:
        raise InputError(
            f"{out} holds {standing.schema}, not {schema}: nothing was replaced; "
            "choose another --out"
        )
    if extra := _unlisted(out, standing):
        raise InputError(
            f"{out / extra[0]} is no part of the artifact: nothing was replaced; move it away"
        )
    if not force:
        read_manifest(out, schema)


def read_manifest(path: Path, schema: str | None = None) -> Manifest:
    """The manifest of a published artifact, with every listed file checked for presence and size.

    Raises: InputError naming the damaged or missing file and the remedy.
    """
    path = Path(path)
    if not is_published(path):
        raise InputError(
            f"{path / MANIFEST} is missing: not a finished artifact; run the stage "
            "that makes it again"
        )
    manifest = parse_manifest(path)
    if schema is not None and manifest.schema != schema:
        older = manifest.schema.rpartition("/")[0] == schema.rpartition("/")[0]
        remedy = (
            "another version of chebsplat made it: make it again"
            if older
            else ("pass the right artifact")
        )
        raise InputError(
            f"{path / MANIFEST} has schema {manifest.schema}, expected {schema}; {remedy}"
        )
    for name, entry in manifest.files.items():
        member = os.path.join(path, name)
        try:
            state = os.stat(member)
        except OSError:
            state = None
        if state is None or not stat.S_ISREG(state.st_mode):
            raise InputError(f"{member} is missing; {remedy_of(path)}")
        if state.st_size != entry["bytes"]:
            raise InputError(
                f"{member} has {state.st_size} bytes, expected {entry['bytes']}; {remedy_of(path)}"
            )
    return manifest


def verify(path: Path, schema: str | None = None) -> Manifest:
    """`read_manifest`, and every digest recomputed and every unlisted file reported."""
    path = Path(path)
    manifest = read_manifest(path, schema)
    for name in manifest.files:
        checked(path, manifest, name)
    if extra := _unlisted(path, manifest):
        raise InputError(
            f"{path / extra[0]} is not listed in {MANIFEST} ({len(extra)} such); {remedy_of(path)}"
        )
    return manifest


def checked(path: Path, manifest: Manifest, name: str) -> Path:
    """Path of one listed file after comparing its digest. Raises InputError if it differs."""
    entry = manifest.files.get(name)
    if entry is None:
        raise InputError(
            f"{path / name} is not part of this {manifest.schema} artifact; {remedy_of(path)}"
        )
    if sha256_file(path / name) != entry["sha256"]:
        raise InputError(f"{path / name} does not match its sha256; {remedy_of(path)}")
    return path / name


def _members(root: Path) -> dict[str, Path]:
    return {p.relative_to(root).as_posix(): p for p in sorted(root.rglob("*")) if p.is_file()}


def _unlisted(path: Path, manifest: Manifest) -> list[str]:
    return sorted(_members(path).keys() - manifest.files.keys() - {MANIFEST})


def _entry(path: Path) -> dict[str, Any]:
    return {"sha256": sha256_file(path), "bytes": path.stat().st_size}


def _settle(root: Path) -> dict[str, dict[str, Any]]:
    """Make files outlive a power cut, and as readable as the user's umask has made their folder
    (some writers give a file to its owner alone); returns their sizes and digests by name.

    Choices: eight at a time, since a disk writes many files in little more time than one.
    """
    mode, members = root.stat().st_mode & 0o666, _members(root)

    def settle(path: Path) -> dict[str, Any]:
        path.chmod(mode)
        sync(path)
        return _entry(path)

    with ThreadPoolExecutor(8) as threads:
        return dict(zip(members, threads.map(settle, members.values()), strict=True))


def digest(value: Mapping[str, Any]) -> str:
    """sha256 (first 16 hex digits) of a JSON-able mapping in canonical form."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def discard(scratch: Path) -> None:
    """Remove a scratch directory. Raises ValueError if it is none, so that no user's file goes."""
    if not scratch.name.startswith((".part-", ".tmp-")):
        raise ValueError(f"{scratch} is no scratch directory")
    if scratch.exists():
        shutil.rmtree(scratch)


def write_document(path: Path, value: Any) -> None:
    """Write `value` as JSON. Raises ValueError on nan, and on what UTF-8 cannot hold."""
    path.write_text(
        json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def read_document(root: Path, manifest: Manifest, name: str) -> Any:
    """A listed document, after comparing its digest. Raises InputError naming file and remedy."""
    return parse_json(checked(root, manifest, name), remedy_of(root))
