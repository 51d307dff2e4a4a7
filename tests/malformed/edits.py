"""How a whole source is spoiled: small edits of its files, and cases that are one edit each."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from malformed.case import Asked, Case, ingest

Edit = Callable[[Path], Any]
Row = tuple[str, str, Edit]  # the case's name, what stderr must name, the edit
NO_FILES = ("pipe", "device", "folder", "dangling link", "looping link")


def put(place: str, content: str | bytes) -> Edit:
    def edit(source: Path) -> None:
        path = source / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return edit


def remove(place: str) -> Edit:
    def edit(source: Path) -> None:
        path = source / place
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return edit


def cut(place: str, n_bytes: int) -> Edit:
    """Without the last bytes."""
    return lambda source: (source / place).write_bytes((source / place).read_bytes()[:-n_bytes])


def grown(place: str, more: bytes) -> Edit:
    return lambda source: (source / place).write_bytes((source / place).read_bytes() + more)


def swollen(place: str, size: int) -> Edit:
    """As large as that without taking a block of the disk."""
    return lambda source: os.truncate(source / place, size)


def no_file(place: str, kind: str) -> Edit:
    """Something else under a file's name."""

    def edit(source: Path) -> None:
        path = source / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to(Path("/dev/zero") if kind == "device" else path if kind == "looping link" else source / "-")

    return edit


def changed(place: str, change: Callable[[Any], Any]) -> Edit:
    """A JSON document after `change`, which works in place or returns another."""

    def edit(source: Path) -> None:
        path = source / place
        document = json.loads(path.read_text()) if path.is_file() else {}
        put(place, json.dumps(change(document) or document))(source)

    return edit


def keys(place: str, **values: Any) -> Edit:
    return changed(place, lambda document: document | values)


def picture(place: str, size: tuple[int, int] = (8, 6), mode: str = "RGB", form: str = "PNG") -> Edit:
    """An image of any format, whatever its name."""

    def edit(source: Path) -> None:
        from PIL import Image

        held = io.BytesIO()
        Image.new(mode, size).save(held, form)
        put(place, held.getvalue())(source)

    return edit


def declared_png(width: int, height: int, color: int = 2) -> bytes:
    """A PNG that says how large it is and holds a few rows of nothing."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    start = struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0)
    pixels = zlib.compress(bytes(1 << 16))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def no_files(*places: str, kinds: Sequence[str] = ("pipe", "dangling link")) -> Iterator[Row]:
    """What is no file, under each of the names."""
    for place in places:
        for kind in kinds:
            yield f"{place} is a {kind}", place.split("/")[-1], no_file(place, kind)


def all_of(*edits: Edit) -> Edit:
    return lambda source: [edit(source) for edit in edits]


def ingested(
    kind: str, write: Callable[[Path], Any], rows: Iterable[Row], layout: str | None = None, **settings: Any
) -> Iterator[Case]:
    """Each edit of a source that `write` makes, met by the ingest stage; `layout`: the kind, None: as detected."""
    for name, named, edit in rows:

        def build(folder: Path, named: str = named, edit: Edit = edit) -> Asked:
            return ingest(folder, _source(folder, write, edit), named, layout, **settings)

        yield Case(kind, name, build)


def planned(kind: str, write: Callable[[Path], Any], rows: Sequence[Row]) -> Iterator[Case]:
    """The same met by `plan`, which reads what decides about keys."""
    for name, named, edit in rows:

        def build(folder: Path, named: str = named, edit: Edit = edit) -> Asked:
            return Asked(["plan", "--scene", f"{_source(folder, write, edit)}/"], named)

        yield Case(kind, f"{name}, in plan", build)


def _source(folder: Path, write: Callable[[Path], Any], edit: Edit) -> Path:
    source = folder / "shared/scene"  # tables may lie beside a scene
    source.mkdir(parents=True)
    write(source)
    edit(source)
    return source
