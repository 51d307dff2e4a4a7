"""Texts of numbers as data sets hold poses, intrinsics and trajectories, spoiled in the ways that all share."""

from __future__ import annotations

from collections.abc import Iterator

from malformed.edits import Row, no_files, put, remove, swollen

EYE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
ANY: dict[str, str | bytes] = {
    "nothing": "",
    "words": "camera to world\n",
    "binary": bytes(range(256)),
    "zeros": bytes(500),
    "one number": "1\n",
    "half a matrix": "1 0 0 0\n0 1 0 0\n",
    "commas": EYE.replace(" ", ","),
    "a ragged row": EYE.replace("0 0 1 0", "0 0 1"),
    "UTF-16": EYE.encode("utf-16"),
}
POSES = {
    "a scale": EYE.replace("1", "2"),
    "zeros for a rotation": "0 0 0 0\n0 0 0 0\n0 0 0 0\n0 0 0 1\n",
    "a mirror": EYE.replace("0 0 1 0", "0 0 -1 0"),
    "a place 1e30 away": EYE.replace("1 0 0 0", "1 0 0 1e30"),
    "a place 1e7 away": EYE.replace("1 0 0 0", "1 0 0 1e7"),
    "1e300 for a rotation": EYE.replace("1", "1e300"),
    "a last row of ones": EYE.replace("0 0 0 1\n", "1 1 1 1\n"),
}
INTRINSICS = {
    "a focal length of 0": EYE.replace("1", "0"),
    "a focal length of -10": "-10 0 4 0\n0 10 3 0\n0 0 1 0\n0 0 0 1\n",
    "a focal length of 1e300": "1e300 0 4 0\n0 10 3 0\n0 0 1 0\n0 0 0 1\n",
    "a focal length of nan": "nan 0 4 0\n0 10 3 0\n0 0 1 0\n0 0 0 1\n",
    "cx = 1e30": "10 0 1e30 0\n0 10 3 0\n0 0 1 0\n0 0 0 1\n",
    "a focal length of 5000 digits": EYE.replace("1 0 0 0", "9" * 5000 + " 0 0 0"),
    "cy = inf": "10 0 4 0\n0 10 inf 0\n0 0 1 0\n0 0 0 1\n",
}


def matrix_rows(place: str, values: dict[str, str]) -> Iterator[Row]:
    """A file of one matrix: what no matrix file may hold, and `values`."""
    name = place.split("/")[-1]
    for what, content in (ANY | values).items():
        yield f"{name} holds {what}", name.removesuffix(".txt"), put(place, content)
    yield f"{name} has a terabyte of zeros", name, swollen(place, 10**12)
    yield from no_files(place)


def gone(place: str) -> Row:
    return f"{place.split('/')[-1]} is missing", place.split("/")[-1], remove(place)
