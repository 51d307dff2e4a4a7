"""Point clouds: PLY files that are cut, lie about their size, or hold no points that a scene could have."""

from __future__ import annotations

import struct

import numpy as np


def header(n: object = 20, form: str = "binary_little_endian 1.0", axes: str = "xyz", more: str = "") -> bytes:
    rows = "".join(f"property float {axis}\n" for axis in axes)
    return f"ply\nformat {form}\nelement vertex {n}\n{rows}{more}end_header\n".encode()


def points(n: int = 20, **values: float) -> bytes:
    """`values`: of the last point, by axis."""
    rows = np.arange(3 * n, dtype="<f4").reshape(n, 3)
    for axis, value in values.items():
        rows[-1, "xyz".index(axis)] = value
    return rows.tobytes()


COLORS = "".join(f"property double {name}\n" for name in ("red", "green", "blue"))
FACES = "element face 1\nproperty list uint int vertex_index\n"
CLOUDS: dict[str, bytes] = {
    "whole": header() + points(),
    "empty": b"",
    "text": b"a cloud of points\n",
    "a header without an end": header()[:-11],
    "a header of two megabytes": header(more="comment a\n" * 200_000) + points(),
    "no format": header().replace(b"format", b"comment") + points(),
    "another format": header(form="binary_middle_endian 1.0") + points(),
    "cut in a row": header() + points()[:-5],
    "cut after the header": header(),
    "0 points": header(0),
    "-1 points": header(-1) + points(),
    "10^12 points": header(10**12) + points(),
    "2^64 points": header(2**64) + points(),
    "10^12 points as text": header(10**12, "ascii 1.0") + b"0 0 0\n" * 20,
    "10^5 points of 10,000 properties": header(10**5, more="".join(f"property double p{k}\n" for k in range(2000)))
    + bytes(1 << 18),
    "a number of points of 5000 digits": header("9" * 5000) + points(),
    "a word for the number of points": header("many") + points(),
    "no z": header(axes="xy") + points(),
    "lists for x": header().replace(b"property float x", b"property list uint float x") + b"\xff" * 400,
    "words as text": header(2, "ascii 1.0") + b"a b c\nd e f\n",
    "too few rows of text": header(9, "ascii 1.0") + b"0 0 0\n" * 5,
    "nan": header() + points(x=float("nan")),
    "inf": header() + points(y=float("inf")),
    "1e38 away": header() + points(z=1e38),
    "1e7 away": header() + points(x=-1e7),
    "colours as doubles": header(more=COLORS) + bytes(20 * 36),
    "a face of 2^32 corners": header(more=FACES) + points() + struct.pack("<I", 2**32 - 1),
    "no vertices": header().replace(b"vertex", b"edge") + points(),
    "a header that is no ASCII": header(more="comment \xff\n") + points()[:-1],
    "two x": header(axes="xxyz") + points() * 2,
}  # fmt: skip
