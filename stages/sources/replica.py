"""Replica as rendered by NICE-SLAM (results/, traj.txt) and by Semantic-NeRF (Sequence_1/)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.images import header
from chebsplat.stages.sources import assembly, cameras, common, labels, texts
from chebsplat.stages.sources.common import Frame, Listing

VOID = 0  # Semantic-NeRF's id of pixels without a class
SEQUENCE, CLASSES = "Sequence_1", "semantic_class"
# stored units in one scene unit: depth stays below 1e6, and is never rounded to 0
SCALES = (0.1, 1e6)


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture."""
    return assembly.assemble(_listing(folder), settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """Reads names only. Where one image has depth, all must: `read` fails otherwise."""
    if (folder / "results").is_dir():
        depth = any(name.startswith("depth") for name in common.names_below(folder / "results"))
        return {"poses": True, "depth": depth, "labels": False}
    depth = any(common.names_below(folder / SEQUENCE / "depth"))
    return {
        "poses": True,
        "depth": depth,
        "labels": bool(labels.files(folder / SEQUENCE, (CLASSES,))),
    }


def files(folder: Path) -> list[Path]:
    """Trajectory, camera, class names, and every image, depth and label."""
    tables = [
        folder / "traj.txt",
        folder / SEQUENCE / "traj_w_c.txt",
        *_parameter_files(folder),
        *_class_files(folder),
    ]
    places = [folder / "results", *(folder / SEQUENCE / part for part in ("rgb", "depth"))]
    data = [place / name for place in places for name in common.names_below(place)]
    data += labels.files(folder / SEQUENCE, (CLASSES,))
    return sorted([*(path for path in tables if common.present(path)), *data])


def _parameter_files(folder: Path) -> list[Path]:
    return [folder / "cam_params.json", folder.parent / "cam_params.json"]


def _class_files(folder: Path) -> list[Path]:
    places = (folder, folder / "habitat", folder / SEQUENCE, folder.parent)
    return [place / "info_semantic.json" for place in places]


def _listing(folder: Path) -> Listing:
    if (folder / "results").is_dir():
        return _nice_slam(folder)
    if (folder / SEQUENCE).is_dir():
        return _semantic_nerf(folder)
    raise InputError(
        f"{folder} holds neither results/ (NICE-SLAM) nor {SEQUENCE}/ (Semantic-NeRF); correct "
        "source.path"
    )


def _trajectory(path: Path, names: list[str]) -> np.ndarray:
    """cam_from_world [V, 4, 4] of the named images, from a row of 16 camera-to-world entries each.

    Raises:  InputError unless the images are numbered 0 to V − 1 and there are V rows: a missing
      frame must not shift the others.
    """
    rows = texts.read_rows(path)
    if len(rows) != len(names):
        raise InputError(
            f"{path} has {len(rows)} poses for {len(names)} images; restore the file or the images"
        )
    matches = [re.search(r"(\d+)$", name) for name in names]
    numbers = [int(match[1]) if match else -1 for match in matches]
    if sorted(numbers) != list(range(len(names))):
        lacking = next(k for k in range(len(names)) if numbers.count(k) != 1)
        raise InputError(
            f"{path} counts frames from 0, but image {lacking} is missing or there "
            "twice; restore it"
        )
    matrices = np.empty((len(rows), 16))
    for k, row in enumerate(rows):
        try:
            matrices[k] = [float(v) for v in row]
        except ValueError as error:
            reason = str(error)[: texts.LONGEST]
            raise InputError(
                f"{path}: row {k + 1} does not hold 16 numbers ({reason}); restore the file"
            ) from None
    return cameras.cam_from_world(path, matrices[numbers].reshape(-1, 4, 4), names)


def _nice_slam(folder: Path) -> Listing:
    place = folder / "results"
    images = [name for name in common.images_in(place) if name.startswith("frame")]
    if not images:
        raise InputError(f"{place} holds no frame*.jpg; the source is incomplete")
    parameters = next((path for path in _parameter_files(folder) if common.present(path)), None)
    if parameters is None:
        raise InputError(
            f"{folder / 'cam_params.json'} is missing, here and one level up; the "
            "source is incomplete"
        )
    try:
        v = texts.read_json(parameters)["camera"]
        # Their principal point counts from the centre of the first pixel.
        params = (v["fx"], v["fy"], texts.number(v["cx"]) + 0.5, texts.number(v["cy"]) + 0.5)
        camera = cameras.camera_of(parameters, "PINHOLE", params, v["w"], v["h"])
        scale = texts.number(v["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{parameters} lacks a camera's fx, fy, cx, cy, w, h or scale ({error}); restore it"
        ) from None
    if not SCALES[0] <= scale <= SCALES[1]:
        raise InputError(
            f"{parameters}: a depth scale of {scale:g} is outside {SCALES[0]:g}...{SCALES[1]:g}; "
            "restore it"
        )
    names = [common.stem(name) for name in images]
    has_depth = probe(folder)["depth"]
    frames = []
    for name, image, pose in zip(
        names, images, _trajectory(folder / "traj.txt", names), strict=True
    ):
        depth = place / f"depth{name.removeprefix('frame')}.png"
        frames.append(Frame(name, place / image, camera, pose, depth if has_depth else None))
    return Listing("replica", frames, depth_scale=scale, notes=["Replica as NICE-SLAM renders it."])


def _semantic_nerf(folder: Path) -> Listing:
    sequence = folder / SEQUENCE
    images = [name for name in common.images_in(sequence / "rgb") if name.startswith("rgb_")]
    if not images:
        raise InputError(f"{sequence / 'rgb'} holds no rgb_N.png; the source is incomplete")
    (width, height), _ = header(sequence / "rgb" / images[0])
    camera = cameras.camera_of(
        sequence, "PINHOLE", (width / 2, width / 2, width / 2, height / 2), width, height
    )
    has = probe(folder)
    names = [common.stem(name) for name in images]
    of_labels = [name.replace("rgb", CLASSES, 1) for name in names]
    maps = labels.of_views(sequence / CLASSES, of_labels) if has["labels"] else {}
    frames = []
    for name, image, pose in zip(
        names, images, _trajectory(sequence / "traj_w_c.txt", names), strict=True
    ):
        n = name.removeprefix("rgb_")
        frames.append(
            Frame(
                name,
                sequence / "rgb" / image,
                camera,
                pose,
                sequence / f"depth/depth_{n}.png" if has["depth"] else None,
                maps.get(f"{CLASSES}_{n}"),
            )
        )
    classes = _class_names(folder)
    return Listing(
        "replica", frames, classes, CLASSES, notes=["Replica as Semantic-NeRF renders it."]
    )


def _class_names(folder: Path) -> dict[int, str] | None:
    """Class names by id, of the nearest info_semantic.json; void is none of them."""
    path = next((path for path in _class_files(folder) if common.present(path)), None)
    if path is None:
        return None
    try:
        pairs = [(entry["id"], entry["name"]) for entry in texts.read_json(path)["classes"]]
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{path} lacks classes with id and name ({error}); restore the file"
        ) from None
    names = labels.names_by_id(path, pairs)
    return {k: name for k, name in names.items() if k != VOID}
