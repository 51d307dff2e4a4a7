"""Folders of photos: files that are no photos, names that are none, absurd sizes, videos instead of photos."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from malformed.case import Case
from malformed.edits import (
    NO_FILES,
    Edit,
    Row,
    all_of,
    cut,
    declared_png,
    ingested,
    no_files,
    picture,
    planned,
    put,
    remove,
    swollen,
)

KIND = "photos"
OTHERS = ("BMP", "GIF", "ICO", "PCX", "PDF", "PPM", "TGA", "TIFF", "WEBP", "DDS", "JPEG2000")
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\n0 0 moveto 8 6 lineto stroke\nshowpage\n"
CONTENTS: dict[str, str | bytes] = {
    "nothing": b"",
    "one byte": b"\xff",
    "text": "a photo of the sofa",
    "a web page": "<!doctype html><title>404</title>",
    "an EPS": EPS,
    "zeros": bytes(4096),
    "a PNG's first bytes": b"\x89PNG\r\n\x1a\n",
    "a JPEG's first bytes": b"\xff\xd8\xff\xe0\x00\x10JFIF",
    "a pickle": b"cos\nsystem\n(S'exit 1'\ntR.",
    "a PNG of 10,000 million pixels": declared_png(100_000, 100_000),
    "a PNG of 177 million pixels": declared_png(13_300, 13_300, 6),
    "a PNG of 2^31 columns": declared_png(2**31 - 1, 1),
    "a PNG without rows": declared_png(8, 0),
    "a PNG of fewer rows than it says": declared_png(4000, 4000),
    "a JPEG of 65,500 squared": b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xdc\xff\xdc\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01",
}
VIDEOS = ("mp4", "MOV", "avi", "mkv", "webm")
STILLS = ("avif", "webp", "tif", "dng", "CR2", "gif", "bmp")
NAMES = {"bytes that are no UTF-8": b"photo\xff\xfe.jpg", "a newline": b"photo\n.jpg", "an escape": b"photo\x1b[2J.png"}


def write(source: Path) -> None:
    for name in ("a.jpg", "b.jpg", "c.png"):
        picture(name, form="JPEG" if name.endswith("jpg") else "PNG")(source)


def named(raw: bytes) -> Edit:
    """A photo under a name of any bytes."""
    return lambda source: os.rename(source / "b.jpg", os.path.join(os.fsencode(source), raw))


def instead(*names: str) -> Edit:
    """Other files where the photos were."""
    return all_of(*map(remove, ("a.jpg", "b.jpg", "c.png")), *(put(name, b"\0" * 64) for name in names))


def rows() -> Iterator[Row]:
    for what, content in CONTENTS.items():
        yield f"b.jpg holds {what}", "b.jpg", put("b.jpg", content)
    for form in OTHERS:
        yield f"b.jpg is a {form}", "b.jpg", picture("b.jpg", form=form)
    yield from no_files("b.jpg", kinds=NO_FILES)
    for what, raw in NAMES.items():
        yield f"a name with {what}", "photo", named(raw)
    yield "a JPEG is cut", "b.jpg", cut("b.jpg", 300)
    yield "a PNG is cut", "c.png", cut("c.png", 30)
    yield "a JPEG of 100 TB of nothing", "b.jpg", all_of(put("b.jpg", b""), swollen("b.jpg", 10**12))
    yield "16 bits", "c.png", picture("c.png", mode="I;16")
    yield "70,000 columns", "c.png", picture("c.png", (70_000, 1))
    yield "65 million pixels", "c.png", picture("c.png", (65_000, 1001), mode="1")
    yield "two suffixes of one name", "b.jpg", picture("b.png")
    yield "one photo", "ingest.min_views", all_of(remove("a.jpg"), remove("b.jpg"))


def alone() -> Iterator[Row]:
    for suffix in STILLS:
        yield f"only .{suffix}", f"1 .{suffix.lower()}", instead(f"IMG_1.{suffix}")
    for suffix in VIDEOS:
        yield f"two .{suffix}", f"2 .{suffix.lower()}", instead(f"a.{suffix}", f"b.{suffix}")
    yield "nothing", "scene", instead()


def cases() -> Iterator[Case]:
    yield from ingested(KIND, write, rows(), "photos")
    yield from ingested(KIND, write, [("no test view", "ingest.test_offset", lambda source: None)], test_offset=7)
    one = all_of(remove("a.jpg"), remove("b.jpg"))
    yield from ingested(KIND, write, [("all are test views", "ingest.test_every", one)], min_views=1)
    yield from planned(KIND, write, [*no_files("b.jpg", kinds=NO_FILES), *alone()])
    yield from planned(KIND, write, [(f"a name with {what}", "photo", named(raw)) for what, raw in NAMES.items()])
