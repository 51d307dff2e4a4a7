"""How a folder or a file is spoiled: small edits that take the folder."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Edit = Callable[[Path], Any]
DEEP = "[" * 50_000
NO_FILES = ("pipe", "device", "folder", "dangling link", "looping link")
EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\n0 0 moveto 8 6 lineto "
    b"stroke\nshowpage\n"
)


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


def flipped(place: str) -> Edit:
    """Another last byte."""

    def edit(source: Path) -> None:
        data = bytearray((source / place).read_bytes())
        data[-1] ^= 1
        (source / place).write_bytes(bytes(data))

    return edit


def swollen(place: str, size: int = 10**12) -> Edit:
    """As large as that without taking a block of the disk."""
    return lambda source: os.truncate(source / place, size)


def no_file(place: str, kind: str) -> Edit:
    """Something else under a file's name: one of NO_FILES."""

    def edit(source: Path) -> None:
        path = source / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to(
                Path("/dev/zero")
                if kind == "device"
                else path
                if kind == "looping link"
                else source / "-"
            )

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


def picture(
    place: str, size: tuple[int, int] = (8, 6), mode: str = "RGB", form: str = "PNG"
) -> Edit:
    """An image of any format, whatever its name."""

    def edit(source: Path) -> None:
        held = io.BytesIO()
        Image.new(mode, size).save(held, form)
        put(place, held.getvalue())(source)

    return edit


def declared_png(width: int, height: int, color: int = 2) -> bytes:
    """A PNG that says how large it is and holds a few rows of nothing."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    start = struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0)
    pixels = zlib.compress(bytes(1 << 16))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def npy(array: np.ndarray, **header: Any) -> bytes:
    """An .npy file whose `header` may declare what it does not hold."""
    held = io.BytesIO()
    said = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape} | header
    np.lib.format.write_array_header_1_0(held, said)
    return held.getvalue() + array.tobytes()


def npz(**members: bytes) -> bytes:
    """An .npz of such files."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return held.getvalue()


def all_of(*edits: Edit) -> Edit:
    return lambda source: [edit(source) for edit in edits]
