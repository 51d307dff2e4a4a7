"""Replica by NICE-SLAM and by Semantic-NeRF: trajectories, camera parameters and class names that are none."""

from __future__ import annotations

from collections.abc import Iterator

from source_folders import ROW, write_nice_slam, write_semantic_nerf

from malformed.case import Case
from malformed.edits import Row, changed, ingested, keys, no_files, picture, planned, put, remove, swollen
from malformed.tables import gone

SLAM, NERF = "NICE-SLAM", "Semantic-NeRF"
TRAJECTORY, CAMERA, CLASSES = "traj.txt", "../cam_params.json", "info_semantic.json"
TEXTS: dict[str, str | bytes] = {
    "nothing": "",
    "binary": bytes(range(256)),
    "words": "a\nb\nc\n",
    "a row too few": ROW.format(0) * 2,
    "a row too many": ROW.format(0) * 40,
    "a row of 15 numbers": ROW.format(0) * 2 + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0\n",
    "a row of 17 numbers": ROW.format(0) * 2 + ROW.format(0).rstrip() + " 1\n",
    "a word": ROW.format(0) * 2 + ROW.format("far"),
    "a place 1e30 away": ROW.format(0) * 2 + ROW.format(1e30),
    "a place -1e7 away": ROW.format(0) * 2 + ROW.format(-1e7),
    "a rotation twice the size": ROW.format(0) * 2 + ROW.format(0).replace("1", "2"),
    "a rotation of zeros": ROW.format(0) * 2 + ROW.format(0).replace("1", "0"),
}


def slam_rows() -> Iterator[Row]:
    for what, content in TEXTS.items():
        yield f"traj.txt holds {what}", TRAJECTORY, put(TRAJECTORY, content)
    yield "all poses are nan", "ingest.min_views", put(TRAJECTORY, ROW.format("nan") * 3)
    yield "traj.txt has a terabyte of zeros", TRAJECTORY, swollen(TRAJECTORY, 10**12)
    yield gone(TRAJECTORY)
    yield gone(CAMERA)
    yield gone("results/frame000001.jpg")[0], TRAJECTORY, remove("results/frame000001.jpg")
    yield gone("results/depth000001.png")
    yield from no_files(TRAJECTORY, CAMERA, "results/frame000001.jpg")
    for content in ("[" * 50_000, "[]", "{}", '{"camera": []}', '{"camera": null}', b"\xff", ""):
        yield f"cam_params.json = {content[:14]!r}", "cam_params.json", put(CAMERA, content)
    for key, values in {"w": (0, -8, 1e9, "8", None, True, 2**70), "h": (0, [6]),
                        "fx": (0, -1, 1e300, 1e-300, "ten", {}, float("nan")), "fy": (float("inf"), None),
                        "cx": (1e30, "4"), "cy": (-1e4, []),
                        "scale": (0, -1, 1e300, 1e-300, "x", True, None, float("nan"), 1e7, 1e-3)}.items():  # fmt: skip
        for value in values:
            change = changed(CAMERA, lambda d, key=key, value=value: {"camera": d["camera"] | {key: value}})
            yield f"{key} = {value!r}", "cam_params.json", change
    yield "a frame number of 200 digits", TRAJECTORY, picture(f"results/frame{'9' * 200}.jpg", form="JPEG")


def nerf_rows() -> Iterator[Row]:
    for content in (
        "[" * 50_000,
        "[]",
        "{}",
        '{"classes": 3}',
        '{"classes": ["a"]}',
        '{"classes": {"1": "wall"}}',
        b"\xff",
    ):
        yield f"info_semantic.json = {content[:20]!r}", CLASSES, put(CLASSES, content)
    for entry in ({"id": None, "name": "a"}, {"id": -1, "name": "a"}, {"id": 1e30, "name": "a"},
                  {"id": True, "name": "a"},
                  {"id": 70_000, "name": "a"}, {"id": 1}, {"id": 1, "name": None}, {"id": 1, "name": ""},
                  {"id": 1, "name": {}}, {"name": "a"}):  # fmt: skip
        yield f"class {entry}", CLASSES, keys(CLASSES, classes=[entry])
    yield "no class of the images is named", "label", keys(CLASSES, classes=[{"id": 9, "name": "wall"}])
    yield from no_files(CLASSES)
    sequence = "Sequence_1"
    yield "traj_w_c.txt is empty", "traj_w_c.txt", put(f"{sequence}/traj_w_c.txt", "")
    yield gone(f"{sequence}/semantic_class/semantic_class_3.png")
    yield gone(f"{sequence}/depth/depth_3.png")
    yield gone(f"{sequence}/rgb")


def cases() -> Iterator[Case]:
    yield from ingested(SLAM, write_nice_slam, slam_rows(), "replica")
    yield from ingested(NERF, write_semantic_nerf, nerf_rows(), "replica")
    yield from planned(SLAM, write_nice_slam, list(no_files(TRAJECTORY)))
