"""Cameras in other programs' files: COLMAP's text model, transforms.json, 3DGS' cameras.json.

World, units and pixel centres (half integers) are those of the scene; axes are those of each
format. Images are named by the view with .png.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import atomic_write, parse_json
from chebsplat.stages.sources.cameras import cam_from_world, camera_of
from chebsplat.stages.sources.common import stem
from chebsplat.stages.sources.texts import number
from chebsplat.stages.sources.transforms import OPENGL
from chebsplat.stages.tools.scene import Camera

AGAIN = "write it again"


def write_cameras(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """Write cameras as sparse/0 (COLMAP), transforms.json and cameras.json; returns the files.

    Raises: ConfigError if one of them exists.
    """
    contents = colmap_texts(cameras) | {
        "transforms.json": json.dumps(transforms(cameras), indent=1),
        "cameras.json": json.dumps(gs_cameras(cameras), indent=1),
    }
    paths = {folder / name: text for name, text in contents.items()}
    for path in paths:
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
    for path, text in paths.items():
        atomic_write(path, text)
    return list(paths)


def colmap_texts(cameras: Sequence[Camera]) -> dict[str, str]:
    """COLMAP's text model by file: a PINHOLE camera for each lens and size, no points."""
    lenses: dict[tuple[float, ...], int] = {}
    images = [
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then keypoints, of which there are none"
    ]
    for index, camera in enumerate(cameras, start=1):
        lens = lenses.setdefault(
            (camera.width, camera.height, *map(float, intrinsics(camera))), len(lenses) + 1
        )
        pose = [*quaternion(camera.cam_from_world[:3, :3]), *camera.cam_from_world[:3, 3]]
        images += [f"{index} {' '.join(repr(float(v)) for v in pose)} {lens} {camera.name}.png", ""]
    rows = [f"{key} PINHOLE {' '.join(map(repr, lens))}" for lens, key in lenses.items()]
    return {
        "sparse/0/cameras.txt": "\n".join(
            ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY", *rows, ""]
        ),
        "sparse/0/images.txt": "\n".join([*images, ""]),
        "sparse/0/points3D.txt": "# no points\n",
    }


def transforms(cameras: Sequence[Camera]) -> dict[str, Any]:
    """nerfstudio's document: camera-to-world in OpenGL's axes, intrinsics by frame."""
    keys = ("fl_x", "fl_y", "cx", "cy")
    frames = [
        {"file_path": f"images/{camera.name}.png", "w": camera.width, "h": camera.height}
        | dict(zip(keys, map(float, intrinsics(camera)), strict=True))
        | {"transform_matrix": (np.linalg.inv(camera.cam_from_world) * OPENGL).tolist()}
        for camera in cameras
    ]
    return {"camera_model": "PINHOLE", "frames": frames}


def gs_cameras(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """3DGS' list: position and axes of the camera in the world, OpenCV's. Choices: cx, cy, which
    the format assumes in the middle, are added; readers ignore unknown keys.
    """
    rows = []
    for index, camera in enumerate(cameras):
        fx, fy, cx, cy = map(float, intrinsics(camera))
        row = {"id": index, "img_name": camera.name, "width": camera.width, "height": camera.height}
        row |= {
            "position": camera.position.tolist(),
            "rotation": camera.cam_from_world[:3, :3].T.tolist(),
        }
        rows.append(row | {"fy": fy, "fx": fx, "cx": cx, "cy": cy})
    return rows


def read_cameras(path: Path) -> list[Camera]:
    """The pinhole cameras of a transforms.json or cameras.json, in order; distortion is dropped.

    Raises: InputError naming the file and its unusable part.
    """
    document = parse_json(path)
    if isinstance(document, dict) and isinstance(document.get("frames"), list):
        return _read(
            path, document["frames"], lambda entry: _transforms_camera(path, document | entry)
        )
    if isinstance(document, list):
        return _read(path, document, lambda entry: _gs_camera(path, entry))
    raise InputError(
        f"{path} is neither a transforms.json with frames nor a 3DGS cameras.json; {AGAIN}"
    )


def _read(
    path: Path, entries: list[Any], read: Callable[[dict[str, Any]], tuple[str, np.ndarray, Any]]
) -> list[Camera]:
    if not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path} lists no cameras, or something else; {AGAIN}")
    parsed = [read(entry) for entry in entries]
    names = [name for name, _, _ in parsed]
    poses = cam_from_world(path, np.stack([matrix for _, matrix, _ in parsed]), names)
    if not np.isfinite(poses).all():
        raise InputError(f"{path}: a pose is not finite; {AGAIN}")
    cameras = []
    for (name, _, lens), pose in zip(parsed, poses, strict=True):
        fx, fy, cx, cy = lens.pinhole
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        cameras.append(Camera(name, K, pose, lens.width, lens.height))
    return cameras


def _transforms_camera(path: Path, entry: dict[str, Any]) -> tuple[str, np.ndarray, Any]:
    """Name, camera-to-world [4, 4] in OpenCV's axes, and lens of a frame."""
    with _usable(path):
        width, height = number(entry["w"]), number(entry["h"])
        angled = "fl_x" not in entry
        fx = (
            0.5 * width / math.tan(0.5 * number(entry["camera_angle_x"]))
            if angled
            else number(entry["fl_x"])
        )
        centre = number(entry.get("cx", width / 2)), number(entry.get("cy", height / 2))
        params = fx, number(entry.get("fl_y", fx)), *centre
        matrix = (
            np.vstack([np.array(entry["transform_matrix"], dtype=float), [0, 0, 0, 1]])[:4].reshape(
                4, 4
            )
            * OPENGL
        )
        name = stem(str(entry["file_path"]).removeprefix("./").removeprefix("images/"))
    return name, matrix, camera_of(path, "PINHOLE", params, width, height)


def _gs_camera(path: Path, entry: dict[str, Any]) -> tuple[str, np.ndarray, Any]:
    """Name, camera-to-world [4, 4] and lens of an entry of cameras.json."""
    matrix = np.eye(4)
    with _usable(path):
        matrix[:3, :3] = np.array(entry["rotation"], dtype=float)
        matrix[:3, 3] = np.array(entry["position"], dtype=float)
        width, height = number(entry["width"]), number(entry["height"])
        centre = number(entry.get("cx", width / 2)), number(entry.get("cy", height / 2))
        params = number(entry["fx"]), number(entry["fy"]), *centre
        name = stem(str(entry.get("img_name", entry.get("id", ""))))
    return name, matrix, camera_of(path, "PINHOLE", params, width, height)


@contextmanager
def _usable(path: Path) -> Iterator[None]:
    """Turn errors of a missing or malformed value into an InputError that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)[:80]
        raise InputError(f"{path}: a camera is not usable ({what}); {AGAIN}") from None


def intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy."""
    return camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation [3, 3], w not negative."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])
