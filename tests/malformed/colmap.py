"""COLMAP models, binary and text: cut, endless, inconsistent, or of cameras and poses that nothing was taken with."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from source_folders import image, write_colmap

from malformed.case import Case
from malformed.edits import Edit, Row, cut, grown, ingested, keys, no_files, planned, put, remove, swollen

KIND = "COLMAP"
NAMES = (b"a.png", b"b.png", b"c.png")
PINHOLE, OPENCV, FISHEYE = 1, 4, 5
MODEL = "sparse/0"
BIG = 2**64 - 1
NAN, INF = float("nan"), float("inf")


def camera(kind: int = PINHOLE, size: tuple[int, int] = (8, 6), params: tuple[float, ...] = (10, 10, 4, 3)) -> bytes:
    return struct.pack(f"<QIiQQ{len(params)}d", 1, 1, kind, *size, *params)


def images(
    names: tuple[bytes, ...] = NAMES,
    quaternion: tuple[float, ...] = (1, 0, 0, 0),
    place: tuple[float, ...] = (0, 0, 0),
    of: int = 1,
    n_keypoints: int = 1,
) -> bytes:
    """Three posed images; `quaternion`, `place` and `of` are the last one's."""
    found = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        last = k == len(names) - 1
        pose = (*quaternion, *place) if last else (1, 0, 0, 0, k, 0, 0)
        found += struct.pack("<I7dI", k + 1, *pose, of if last else 1) + name + b"\0"
        found += struct.pack("<Q2dQ", n_keypoints if last else 1, 1, 1, 1)
    return found


def points(n_tracks: int = 1) -> bytes:
    return struct.pack("<QQ3d3BdQII", 1, 1, 0, 0, 2, 9, 9, 9, 0.5, n_tracks, 1, 0)


def write(source: Path) -> None:
    for name in NAMES:
        image(source / "images" / name.decode())
    for name, content in (("cameras", camera()), ("images", images()), ("points3D", points())):
        put(f"{MODEL}/{name}.bin", content)(source)


def binary_rows() -> Iterator[Row]:
    for name in ("cameras", "images", "points3D"):
        file, path = f"{name}.bin", f"{MODEL}/{name}.bin"
        yield f"{file} is empty", file, put(path, b"")
        yield f"{file} holds half a count", file, put(path, b"\1\0\0\0")
        yield f"{file} is a byte short", file, cut(path, 1)
        yield f"{file} is cut in a record", file, cut(path, 30)
        yield f"{file} is a byte too long", file, grown(path, b"\0")
        yield f"{file} counts 2^64 - 1 records", file, put(path, struct.pack("<Q", BIG))
        yield f"{file} counts a record too many", file, put(path, struct.pack("<Q", 4) + images()[8:])
        yield f"{file} is text", file, put(path, "# a list with one line of data for each\n" * 5)
        yield f"{file} has a terabyte of zeros", file, swollen(path, 10**12)
        yield f"{file} is missing", file, remove(path)
        yield from no_files(path)
    endless = images()[:72] + b"a" * 10**6
    yield "a name without an end", "images.bin", put(f"{MODEL}/images.bin", endless)
    for what, n in (("2^64 - 1", BIG), ("2^40", 2**40), ("two", 2)):
        yield f"an image counts {what} keypoints", "images.bin", put(f"{MODEL}/images.bin", images(n_keypoints=n))
        yield f"a point counts {what} tracks", "points3D.bin", put(f"{MODEL}/points3D.bin", points(n))
    yield "an image of no camera", "images.bin", put(f"{MODEL}/images.bin", images(of=7))
    nowhere = {"climb out": b"../../../etc/x.png", "are absolute": b"/etc/x.png", "hold a newline": b"x\ny.png",
               "are no UTF-8": b"\xff\xfe.png", "are empty": b""}  # fmt: skip
    for what, name in nowhere.items():
        content = images(tuple(name + bytes(0) for _ in NAMES))
        yield f"names that {what}", "3 of 3 images", put(f"{MODEL}/images.bin", content)
    for q in ((0, 0, 0, 0), (NAN, 0, 0, 0), (INF, 0, 0, 0), (1, 1, 1, 1), (1e-300, 0, 0, 0), (1e300, 0, 0, 0)):
        yield f"quaternion {q}", "images.bin", put(f"{MODEL}/images.bin", images(quaternion=q))
    for t in ((1e30, 0, 0), (0, -1e308, 0), (0, 0, 1e7), (NAN, 0, 0), (0, INF, 0)):
        yield f"translation {t}", "images.bin", put(f"{MODEL}/images.bin", images(place=t))


CAMERAS: dict[str, tuple[Any, ...]] = {
    "no known model": (99,),
    "a negative model": (-1,),
    "a fisheye": (FISHEYE, (8, 6), (10, 10, 4, 3, 0, 0, 0, 0)),
    "no column": (PINHOLE, (0, 6)),
    "2^40 columns": (PINHOLE, (2**40, 6)),
    "2^63 rows": (PINHOLE, (8, 2**63)),
    "another size than its photos": (PINHOLE, (80, 60), (100, 100, 40, 30)),
    **{f"a focal length of {f}": (PINHOLE, (8, 6), (f, 10, 4, 3)) for f in (0, -10, 1e300, 1e-300, 1e6, NAN, INF)},
    **{f"cx = {c}": (PINHOLE, (8, 6), (10, 10, c, 3)) for c in (1e30, -1e5, 100, NAN)},
    **{f"cy = {c}": (PINHOLE, (8, 6), (10, 10, 4, c)) for c in (1e30, INF)},
    **{f"k1 = {k}": (OPENCV, (8, 6), (10, 10, 4, 3, k, 0, 0, 0)) for k in (1e3, 1e30, 1e300, -1e30, NAN, INF)},
}


def camera_rows() -> Iterator[Row]:
    for what, values in CAMERAS.items():
        named = "images" if "another size" in what else "cameras.bin"
        yield f"a camera of {what}", named, put(f"{MODEL}/cameras.bin", camera(*values))


def text_rows() -> Iterator[Row]:
    lines = {"a.png": "1 1 0 0 0 0 0 0 1 a.png\n\n", "b.png": "2 1 0 0 0 1 0 0 1 b.png\n\n"}
    kept = "".join(lines.values())
    for what, row in {"a pose of nan": "3 nan 0 0 0 2 0 0 1 c.png", "a word": "3 1 0 0 0 2 0 0 one c.png",
                      "no name": "3 1 0 0 0 2 0 0 1", "no camera": "3 1 0 0 0 2 0 0 9 c.png",
                      "a length of 0": "3 0 0 0 0 2 0 0 1 c.png", "half a row": "3 1 0",
                      "a place of 1e999": "3 1 0 0 0 1e999 0 0 1 c.png"}.items():  # fmt: skip
        yield f"images.txt has a row with {what}", "images.txt", put(f"{MODEL}/images.txt", f"{kept}{row}\n")
    for what, row in {"nonsense": "nonsense",
                      "few values": "1 PINHOLE 8 6 10", "many values": "1 PINHOLE 8 6 1 2 3 4 5",
                      "a word": "1 PINHOLE 8 6 ten 10 4 3", "an unknown model": "1 MAGIC 8 6 10 10 4 3",
                      "a size of 1e3": "1 PINHOLE 1e3 6 10 10 4 3", "nan": "1 PINHOLE 8 6 nan 10 4 3",
                      "5000 digits": f"1 PINHOLE {'9' * 5000} 6 10 10 4 3"}.items():  # fmt: skip
        yield f"cameras.txt has {what}", "cameras.txt", put(f"{MODEL}/cameras.txt", f"{row}\n")
    for name in ("cameras.txt", "images.txt"):
        yield f"{name} is empty", "images", put(f"{MODEL}/{name}", "")
        yield f"{name} is binary", name, put(f"{MODEL}/{name}", bytes(range(256)) * 9)
        yield f"{name} is 100 GB", name, swollen(f"{MODEL}/{name}", 10**11)


def document_rows() -> Iterator[Row]:
    deep = "[" * 50_000
    for name in ("scene.json", "labels.json"):
        yield f"{name} is nested", name, put(name, deep)
        yield f"{name} is a list", name, put(name, "[]")
        yield f"{name} is binary", name, put(name, b"\xff\xfe\0")
        yield f"{name} is empty", name, put(name, "")
        yield from no_files(name)
    for value in (None, True, 1, 0, -8, 2.5, 1e30, "8", [8], {}):
        yield f"test_every = {value!r}", "scene.json", keys("scene.json", test_every=value)
    yield "test_every = 1e999", "scene.json", put("scene.json", '{"test_every": 1e999}')
    for value in (None, 3, [3], ["a.png"], [{"file": 3}], [{"path": "a.png"}]):
        yield f"frames = {value!r}", "scene.json", keys("scene.json", test_every=8, frames=value)
    for value in (None, [], "sofa", 7, {"7": None}, {"7": ""}, {"7": " "}, {"7": {}}, {"7": ["sofa"]}, {"7": 1}):
        yield f"labels = {value!r}", "scene.json", keys("scene.json", labels=value)
    for key in ("-1", "65536", "a", "", "7.0", "9" * 5000):
        yield f"a label's id is {key[:9]!r}", "labels.json", put("labels.json", f'{{"{key}": "sofa"}}')
    yield "a label is half a character", "labels.json", put("labels.json", '{"7": "\\ud800"}')


def cases() -> Iterator[Case]:
    yield from ingested(KIND, write, [*binary_rows(), *camera_rows()])
    yield from ingested(KIND, write_colmap, [*text_rows(), *document_rows()])
    yield from planned(KIND, write, [*no_files(f"{MODEL}/images.bin"), ("no model", "sparse", _without_model)])


_without_model: Edit = lambda source: [path.unlink() for path in (source / MODEL).iterdir()]  # noqa: E731
