"""The transforms.json source of nerfstudio and instant-ngp: camera-to-world in OpenGL axes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import common
from chebsplat.stages.sources.common import Camera, Frame, Listing


def read(folder: Path, settings: Any) -> dict[str, Any]:
    """The fields of a capture."""
    return common.assemble(_listing(folder), settings)


def probe(folder: Path) -> dict[str, bool]:
    return _listing(folder).probe()


def files(folder: Path) -> list[Path]:
    return sorted([folder / "transforms.json", *_listing(folder).files()])


def _listing(folder: Path) -> Listing:
    path = folder / "transforms.json"
    document = common.read_json(path)
    if not isinstance(document, dict) or not document.get("frames"):
        raise InputError(f"{path} lists no frames; write it again")
    frames, absent = [], 0
    for entry in document["frames"]:
        try:
            relative, matrix = str(entry["file_path"]), np.array(entry["transform_matrix"], float)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: a frame lacks file_path or transform_matrix ({error}); write it again") from None
        if matrix.shape != (4, 4):
            raise InputError(f"{path}: transform_matrix of {relative} is {matrix.shape}, not (4, 4); write it again")
        image = _on_disk(folder / relative)
        if image is None:
            absent += 1
            continue
        depth = folder / entry["depth_file_path"] if "depth_file_path" in entry else None
        name = str(Path(relative).with_suffix("")).removeprefix("./").removeprefix("images/")
        frames.append(Frame(name, image, _camera(document | entry, image, path), _pose(matrix), depth))
    notes = [f"{absent} of {len(document['frames'])} listed frames are absent on disk."] if absent else []
    return Listing("transforms", frames, notes=notes)


def _on_disk(path: Path) -> Path | None:
    """The file itself, or with an image suffix where the listing leaves it away."""
    candidates = [path, *(path.with_name(path.name + end) for end in common.IMAGE_TYPES)]
    return next((c for c in candidates if c.is_file()), None)


def _pose(matrix: np.ndarray) -> np.ndarray:
    """cam_from_world in OpenCV axes of a camera-to-world matrix in OpenGL axes; nan where it has no inverse."""
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        return np.full((4, 4), np.nan)
    world_from_cam = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
    left, _, right = np.linalg.svd(world_from_cam[:3, :3])
    rotation = (left @ right).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ world_from_cam[:3, 3]
    return pose


def _camera(values: dict[str, Any], image: Path, path: Path) -> Camera:
    try:
        width, height = int(values["w"]), int(values["h"])
    except KeyError:
        width, height = common.open_image(image).size
    if "fl_x" in values:
        fx = float(values["fl_x"])
    elif "camera_angle_x" in values:
        fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
    else:
        raise InputError(f"{path} has neither fl_x nor camera_angle_x; write it again")
    fy = float(values.get("fl_y", fx))
    pinhole = [fx, fy, float(values.get("cx", width / 2)), float(values.get("cy", height / 2))]
    distortion = [float(values.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2")]
    if any(values.get(k) for k in ("k3", "k4")):
        raise InputError(f"{path}: distortion k3 or k4 is not supported; undistort the images first")
    if any(distortion):
        return Camera("OPENCV", pinhole + distortion, width, height)
    return Camera("PINHOLE", pinhole, width, height)
