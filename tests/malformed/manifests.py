"""Artifacts whose manifest or members are damaged, as input of every stage and of the commands that read manifests."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest
from chebsplat.stages.registry import STAGES
from malformed.case import Asked, Case, stage

KEY = "0123456789abcdef"
MEMBER = "data/values.bin"


def fake(path: Path, of: str, key: str = KEY, config: dict[str, Any] | None = None) -> Path:
    """An artifact of stage `of` whose manifest is right, with one member that nobody gets as far as to read."""
    with artifact.publish(path, Manifest(STAGES[of].schema, key, of, config=config or {})) as tmp:
        (tmp / MEMBER).parent.mkdir()
        (tmp / MEMBER).write_bytes(bytes(64))
    return path


def rewritten(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        file = path / "artifact.json"
        file.write_text(json.dumps(change(json.loads(file.read_text()))))

    return damage


def _with(**values: Any) -> Callable[[Path], None]:
    return rewritten(lambda manifest: manifest | values)


def _without(name: str) -> Callable[[Path], None]:
    return rewritten(lambda manifest: {key: value for key, value in manifest.items() if key != name})


def _text(data: bytes) -> Callable[[Path], None]:
    return lambda path: (path / "artifact.json").write_bytes(data) and None  # type: ignore[func-returns-value]


def _renamed(name: str) -> Callable[[Path], None]:
    return rewritten(lambda manifest: manifest | {"files": {name: manifest["files"][MEMBER]}})


def _member(**values: Any) -> Callable[[Path], None]:
    return rewritten(lambda m: m | {"files": {MEMBER: {k: v for k, v in (m["files"][MEMBER] | values).items() if v}}})


def _folder_for_member(path: Path) -> None:
    (path / MEMBER).unlink()
    (path / MEMBER).mkdir()


def _pipe_for_member(path: Path) -> None:
    import os

    (path / MEMBER).unlink()
    os.mkfifo(path / MEMBER)


def _loop_for_manifest(path: Path) -> None:
    (path / "artifact.json").unlink()
    (path / "artifact.json").symlink_to("artifact.json")


DAMAGES: dict[str, Callable[[Path], None]] = {
    "gone": shutil.rmtree,
    "no manifest": lambda path: (path / "artifact.json").unlink(),
    "a manifest that is empty": _text(b""),
    "a manifest cut off": _text(b'{"schema": "chebsplat.'),
    "a manifest of other bytes": _text(b"\xff\xfe\x00"),
    "a manifest nested too deeply": _text(b"[" * 100_000),
    "a manifest that is a list": _text(b"[]"),
    "a manifest that is null": _text(b"null"),
    "a manifest that leads to itself": _loop_for_manifest,
    "a manifest with another field": _with(more=1),
    "another schema": _with(schema="chebsplat.other/9"),
    "a schema that is a number": _with(schema=1),
    "no key": _without("key"),
    "an empty key": _with(key=""),
    "an absolute key": _with(key="/tmp/elsewhere"),
    "a key that climbs": _with(key="../../../x"),
    "a key that is a number": _with(key=1234567890123456),
    "a key with a newline": _with(key=KEY + "\n"),
    "an input whose key climbs": _with(inputs={"capture": {"key": "../x", "schema": "s/1"}}),
    "inputs that are a list": _with(inputs=[KEY]),
    "a config that is a text": _with(config="none"),
    "facts that are a list": _with(facts=[]),
    "seconds that never end": _with(seconds=float("inf")),
    "files that are a list": _with(files=[MEMBER]),
    "a file without sha256": _member(sha256=None),
    "a sha256 that is short": _member(sha256="ab"),
    "a file without bytes": _member(bytes=None),
    "bytes below zero": _member(bytes=-1),
    "bytes that are a fraction": _member(bytes=64.5),
    "a file that climbs": _renamed("../in/" + MEMBER),
    "an absolute file": _renamed("/etc/hostname"),
    "a file without a name": _renamed(""),
    "a file's name with a null byte": _renamed("data/\0"),
    "a file's name too long": _renamed("x" * 300),
    "a member that is gone": lambda path: (path / MEMBER).unlink(),
    "a member cut off": lambda path: (path / MEMBER).write_bytes(bytes(63)) and None,  # type: ignore[func-returns-value]
    "a member that is a folder": _folder_for_member,
    "a member that is a pipe": _pipe_for_member,
}


def _as_input(of: str, role: str, damage: Callable[[Path], None]) -> Callable[[Path], Asked]:
    def build(folder: Path) -> Asked:
        given = {r: fake(folder / r, STAGES[of].roles[r]) for r in {role} | {r for r, _ in STAGES[of].inputs}}
        damage(given[role])
        return stage(of, folder, {}, str(folder / role), **given)

    return build


def _verified(damage: Callable[[Path], None]) -> Callable[[Path], Asked]:
    def build(folder: Path) -> Asked:
        damage(fake(folder / "x", "sfm"))
        return Asked(["verify", folder / "x"], str(folder / "x"))

    return build


def cases() -> Iterator[Case]:
    names = list(DAMAGES)
    places = [(name, role) for name, one in STAGES.items() for role in one.roles]
    for number in range(max(len(places), len(names))):  # every damage and every input, at least once
        (of, role), name = places[number % len(places)], names[number % len(names)]
        yield Case("manifest", f"{of} --in-{role}, {name}", _as_input(of, role, DAMAGES[name]), (3,))
    for name in ("a file that climbs", "an absolute file", "a key that climbs", "a file without sha256", "gone"):
        yield Case("manifest", f"verify, {name}", _verified(DAMAGES[name]), (3,))
    yield Case("manifest", "verify, another byte in a member",
               _verified(lambda path: (path / MEMBER).write_bytes(bytes(63) + b"x") and None), (3,))  # fmt: skip
    yield Case("manifest", "verify, a file beside the members",
               _verified(lambda path: (path / "more").touch()), (3,))  # fmt: skip
