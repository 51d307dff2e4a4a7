"""transforms.json: values that are no numbers, cameras and poses that cannot be, paths that lead elsewhere."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from source_folders import write_transforms

from malformed.case import Case
from malformed.edits import NO_FILES, Edit, Row, all_of, changed, ingested, keys, no_files, planned, put, swollen

KIND = "transforms.json"
FILE = "transforms.json"
NAN, INF = float("nan"), float("inf")


def frame(**values: Any) -> Edit:
    """The second of three frames, changed."""

    def change(document: Any) -> None:
        document["frames"][1] |= values

    return changed(FILE, change)


def by_angle(text: str) -> Edit:
    """The angle as it is written, which JSON might not be able to say."""

    def edit(source: Path) -> None:
        document = json.loads((source / FILE).read_text())
        del document["fl_x"]
        put(FILE, json.dumps(document)[:-1] + f', "camera_angle_x": {text}}}')(source)

    return edit


def moved(value: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[0, 3] = value
    return matrix.tolist()


DOCUMENTS: dict[str, str | bytes] = {
    "nothing": "",
    "half an object": '{"frames": [',
    "a list": "[]",
    "a number": "3",
    "null": "null",
    "a string": '"frames"',
    "binary": bytes(range(256)),
    "UTF-16": '{"frames": []}'.encode("utf-16"),
    "a list nested 100,000 times": "[" * 100_000,
    "an object nested 100,000 times": '{"a":' * 100_000,
    "frames nested 100,000 times": '{"frames": ' + "[" * 100_000,
    "a number of 5000 digits": '{"w": ' + "9" * 5000 + "}",
    "no frames": "{}",
    "half a character": '{"frames": [{"file_path": "\\udcff.png", "transform_matrix": []}]}',
    "a key twice": '{"frames": [], "frames": []}',
}
MATRICES: dict[str, Any] = {
    "null": None, "a word": "eye", "a number": 1, "empty": [], "3 rows": np.eye(4)[:3].tolist(),
    "ragged": [[1], [1, 2]],
    "words": [["1", "0", "0", "0"]] * 4, "truths": (np.eye(4) > 0).tolist(), "zeros": np.zeros((4, 4)).tolist(),
    "twice the size": (2 * np.eye(4)).tolist(), "mirrored": np.diag([1.0, 1, -1, 1]).tolist(),
    "1e30 everywhere": [[1e30] * 4] * 4, "1e300 everywhere": [[1e300] * 4] * 4, "objects": [[{}] * 4] * 4,
    "1e30 away": moved(1e30), "-1e300 away": moved(-1e300), "1e7 away": moved(1e7),
    "integers of 400 digits": [[10**400] * 4] * 4, "nested 70 deep": eval("[" * 70 + "1" + "]" * 70),
}  # fmt: skip
NUMBERS: dict[str, tuple[Any, ...]] = {
    "fl_x": (0, -1, 1e300, 1e-300, NAN, INF, "10", True, None, [10], 10**400),
    "fl_y": (-10, 1e30, "10"),
    "cx": (1e30, -1e6, NAN, "4", None),
    "cy": (INF, {}),
    "w": (0, -8, 9, 1e9, 1e300, NAN, "8", True, None, 10**400),
    "h": (0, 2**63, [6]),
    "k1": (1e30, 1e3, NAN, "0.1", True),
    "k3": (0.1,),
}
PATHS: dict[str, Any] = {
    "climbs out": "../../../../../etc/hostname", "is absolute": "/etc/hostname.png",
    "climbs out late": "images/../../x.png",
    "is null": None, "is empty": "", "is a number": 3, "is a list": ["a.png"],
    "climbs out by backslashes": "..\\..\\x.png",
}  # fmt: skip


def rows() -> Iterator[Row]:
    for what, content in DOCUMENTS.items():
        yield f"holds {what}", FILE, put(FILE, content)
    yield "a terabyte", FILE, swollen(FILE, 10**12)
    for value in (None, [], {}, "a", [None], [3], ["a"], [[]], [{}], [{"file_path": "a.png"}]):
        yield f"frames = {json.dumps(value)}", FILE, keys(FILE, frames=value)
    for what, matrix in MATRICES.items():
        yield f"a matrix: {what}", FILE, frame(transform_matrix=matrix)
    infinite = changed(FILE, lambda d: d | {"frames": [f | {"transform_matrix": [[INF] * 4] * 4} for f in d["frames"]]})
    yield "all matrices infinite", "ingest.min_views", infinite
    for key, values in NUMBERS.items():
        for value in values:
            said = json.dumps(value)[:20]
            yield f"{key} = {said}", "images" if (key, value) == ("w", 9) else FILE, keys(FILE, **{key: value})
    for text in ("0", "-1", "NaN", "Infinity", "1e400", "3.2", "1e-300", '"1"', "true", "null", "[]", "9" * 400):
        yield f"camera_angle_x = {text[:9]}", FILE, by_angle(text)
    yield "a fisheye", FILE, keys(FILE, camera_model="OPENCV_FISHEYE")
    yield "an unknown camera model", FILE, keys(FILE, camera_model={})
    for what, path in PATHS.items():
        yield f"a path that {what}", FILE, frame(file_path=path)
    for key in ("mask_path", "depth_file_path"):
        yield f"{key} climbs out", FILE, frame(**{key: "../../x.png"})
        yield f"{key} is a number", FILE, frame(**{key: 1})
    yield "mask_path names nothing", "x.png", frame(mask_path="masks/x.png")
    yield "the same photo twice", "frame_9", frame(file_path="images/frame_9.png")
    yield (
        "no photo is there",
        "ingest.min_views",
        changed(FILE, lambda d: d | {"frames": [f | {"file_path": "x" + f["file_path"]} for f in d["frames"]]}),
    )
    yield from no_files(FILE, "images/frame_10.png", kinds=NO_FILES)


def cases() -> Iterator[Case]:
    yield from ingested(KIND, write_transforms, rows(), "transforms")
    linked = all_of(frame(mask_path="masks/b.png"), put("masks/a.png", b""))
    unreadable = {"nested 100,000 times": put(FILE, "[" * 100_000), "a path climbs out": frame(file_path="../x.png")}
    rows_of_plan = [("mask_path names nothing", "b.png", linked), *no_files(FILE, kinds=NO_FILES)]
    rows_of_plan += [(what, FILE, edit) for what, edit in unreadable.items()]
    yield from planned(KIND, write_transforms, rows_of_plan)
