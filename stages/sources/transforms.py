"""The transforms.json source of nerfstudio and instant-ngp: camera-to-world in OpenGL axes."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.stages.sources import assembly, cameras, common
from chebsplat.stages.sources.cameras import Camera
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.texts import number, read_json, shortened

PARTS = ("file_path", "depth_file_path", "mask_path")
DISTORTION = ("k1", "k2", "p1", "p2")
HIGHER = ("k3", "k4", "k5", "k6")
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")  # subsets of OPENCV
OPENGL = np.array([1.0, -1.0, -1.0, 1.0])  # y up, z backward -> y down, z forward


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture. `class_names` is of no use here: the format has no labels."""
    return assembly.assemble(_listing(folder), settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """Light: reads the JSON, and asks which files exist only if it lists depth at all."""
    depth = any(entry.get("depth_file_path") for entry in _document(folder)[1])
    if depth:
        present, _ = _present(folder)
        depth = bool(present) and all(entry.get("depth_file_path") for entry, _ in present)
    return {"poses": True, "depth": depth, "labels": False}


def files(folder: Path) -> list[Path]:
    """The JSON, and every image, depth and mask of a frame that is on disk."""
    present, _ = _present(folder)
    beside = [folder / _inside(folder, entry[key]) for entry, _ in present for key in PARTS[1:] if entry.get(key)]
    return sorted([folder / "transforms.json", *(Path(image) for _, image in present), *beside])


def _document(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What all frames share, and the frames as they are listed."""
    path = folder / "transforms.json"
    shared = read_json(path)
    entries = shared.pop("frames", None)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} lists no frames; write it again")
    for entry in entries:
        if not isinstance(entry, dict) or not all(isinstance(entry.get(part, ""), str) for part in PARTS):
            raise InputError(f"{path}: a frame is no object with paths as text; write it again")
        if not entry.get("file_path") or "transform_matrix" not in entry:
            raise InputError(f"{path}: a frame lacks file_path or transform_matrix; write it again")
    return shared, entries


def _present(folder: Path) -> tuple[list[tuple[dict[str, Any], str]], int]:
    """(entry, image) of the frames that are on disk; how many are not."""
    _, entries = _document(folder)
    images = [_on_disk(os.path.join(folder, _inside(folder, entry["file_path"]))) for entry in entries]
    present = [(entry, image) for entry, image in zip(entries, images, strict=True) if image is not None]
    return present, len(entries) - len(present)


def _on_disk(path: str) -> str | None:
    """The file itself, or with an image suffix where the listing leaves it away."""
    paths = [path + end for end in ("", ".png", ".jpg", ".jpeg")]
    return next((p for p in paths if os.path.isfile(p) or (is_image(os.path.basename(p)) and os.path.lexists(p))), None)


def _inside(folder: Path, listed: str) -> str:
    """A listed path relative to the folder. Raises InputError if it leads out of it."""
    path = listed.replace("\\", "/")
    if os.path.isabs(path):
        path = os.path.relpath(path, os.path.abspath(folder))
    path = os.path.normpath(path)
    if path.split("/")[0] == "..":
        raise InputError(f"{folder / 'transforms.json'}: {listed} lies elsewhere; write paths relative to the folder")
    return next(common.printable(folder / "transforms.json", [path]))


def _name(path: str) -> str:
    """A view's name by its path below the folder: relative to images/ if it lies there."""
    return common.stem(path.removeprefix("images/"))


def _listing(folder: Path) -> Listing:
    path = folder / "transforms.json"
    shared, _ = _document(folder)
    present, absent = _present(folder)
    names = [_name(_inside(folder, entry["file_path"])) for entry, _ in present]
    matrices = []
    for (entry, _), name in zip(present, names, strict=True):
        try:
            matrix = np.array(entry["transform_matrix"])
        except ValueError as error:  # ragged, or nested more deeply than arrays can be
            raise InputError(f"{path}: {name} has no usable transform_matrix ({error}); write it again") from None
        if matrix.dtype.kind not in "iuf":
            raise InputError(f"{path}: transform_matrix of {name} does not hold numbers; write it again")
        if matrix.shape != (4, 4):
            raise InputError(f"{path}: transform_matrix of {name} is {matrix.shape}, not (4, 4); write it again")
        matrices.append(matrix * OPENGL)
    poses = cameras.cam_from_world(path, np.reshape(matrices, (-1, 4, 4)), names)
    frames = []
    for (entry, image), name, pose in zip(present, names, poses, strict=True):
        depth, mask = (folder / _inside(folder, entry[part]) if entry.get(part) else None for part in PARTS[1:])
        camera = _camera(shared | entry, Path(image), path)
        frames.append(Frame(name, Path(image), camera, pose, depth, mask=mask))
    notes = [f"{absent} of {absent + len(present)} listed frames are absent on disk."] if absent else []
    return Listing("transforms", frames, notes=notes)


def _camera(values: dict[str, Any], image: Path, path: Path) -> Camera:
    """The camera of one frame. Raises InputError on a fisheye, a higher distortion or no focal length."""
    named = values.get("camera_model")
    model = "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV" if named is None else shortened(named).strip("'")
    if model not in PERSPECTIVE or any(values.get(k) for k in HIGHER):
        model = model if model not in PERSPECTIVE else "FULL_OPENCV"
        return cameras.camera_of(path, model, (), 0, 0)  # raises: says what is supported
    size = (values["w"], values["h"]) if "w" in values and "h" in values else header(image)[0]
    try:
        width, height = (number(v) for v in size)
        fx = _focal(values, "x", width)
        fy = _focal(values, "y", height) or fx
        centre = [number(values.get("cx", width / 2)), number(values.get("cy", height / 2))]
        distortion = [number(values.get(k) or 0.0) for k in DISTORTION]
    except ValueError as error:
        raise InputError(f"{path}: intrinsics are no numbers that can be used ({error}); write it again") from None
    if fx is None or fy is None:
        raise InputError(f"{path} has neither fl_x nor camera_angle_x; write it again")
    if any(distortion):
        return cameras.camera_of(path, "OPENCV", (fx, fy, *centre, *distortion), width, height)
    return cameras.camera_of(path, "PINHOLE", (fx, fy, *centre), width, height)


def _focal(values: dict[str, Any], axis: str, pixels: float) -> float | None:
    """Focal length of an axis in pixels, from fl_* or from the whole angle of view."""
    if f"fl_{axis}" in values:
        return number(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        angle = number(values[f"camera_angle_{axis}"])
        if not 0 < angle < math.pi:
            raise ValueError(f"camera_angle_{axis} is {angle:g}, not between 0 and pi")
        return 0.5 * pixels / math.tan(0.5 * angle)
    return None
