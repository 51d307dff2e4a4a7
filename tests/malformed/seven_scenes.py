"""7-Scenes: frames whose pose, depth or intrinsics are missing, cut or impossible."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from source_folders import image

from malformed.case import Case
from malformed.edits import Row, cut, ingested, no_files, picture, planned, put
from malformed.tables import EYE, INTRINSICS, POSES, gone, matrix_rows

KIND = "7-Scenes"
POSE, COLOR, DEPTH = (f"frame-000001.{end}" for end in ("pose.txt", "color.png", "depth.png"))
INTRINSIC = "camera-intrinsics.txt"


def write(source: Path) -> None:
    for k in range(3):
        image(source / f"frame-{k:06d}.color.png")
        image(source / f"frame-{k:06d}.depth.png", mode="I;16", value=1500)
        put(f"frame-{k:06d}.pose.txt", EYE)(source)
    put(INTRINSIC, "10 0 4\n0 10 3\n0 0 1\n")(source)


def rows() -> Iterator[Row]:
    yield from matrix_rows(POSE, POSES)
    yield from matrix_rows(INTRINSIC, INTRINSICS)
    for place in (POSE, DEPTH):
        yield gone(place)
    yield "a photo is cut", COLOR, cut(COLOR, 30)
    yield "depth is cut", DEPTH, cut(DEPTH, 30)
    yield "depth of 8 bits", DEPTH, picture(DEPTH, mode="L")
    yield "depth of another size", DEPTH, picture(DEPTH, (4, 3), "I;16")
    yield "photos of two sizes", COLOR, picture(COLOR, (16, 12))
    yield "the same frame as JPEG and PNG", "frame-000001", picture("frame-000001.color.jpg", form="JPEG")
    yield from no_files(COLOR, DEPTH)


def cases() -> Iterator[Case]:
    yield from ingested(KIND, write, rows(), "seven_scenes")
    yield from planned(KIND, write, list(no_files(POSE)))
