"""Cameras in other programs' files: COLMAP's model, transforms.json, 3DGS' cameras.json.

World, units and pixel centres (half integers) are those of the scene; axes are those of each
format. Images are named by the view with .png.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.files import atomic_path, atomic_write, explained, parse_json
from chebsplat.formats.points import Points
from chebsplat.formats.world import World
from chebsplat.stages.pages.pictures import png
from chebsplat.stages.sources.cameras import cam_from_world, camera_of
from chebsplat.stages.sources.common import stem
from chebsplat.stages.sources.texts import number
from chebsplat.stages.sources.transforms import OPENGL
from chebsplat.stages.tools.scene import Camera

AGAIN = "write it again"
IMAGES, MASKS = "images/{}.png", "masks/{}.png.png"  # as COLMAP's --mask_path finds these


def write_cameras(
    folder: Path,
    cameras: Sequence[Camera],
    cloud: Points | None = None,
    photos: Mapping[str, Callable[[int], np.ndarray]] | None = None,
) -> list[Path]:
    """Write cameras as sparse/0 (COLMAP), transforms.json and cameras.json; returns their paths.

    Args: cloud: points of the model, in the world of the cameras; photos: functions of a camera's
      index to its image u8, by the format of the image's name.
    Raises: ConfigError if something is there already.
    """
    model, photos = folder / "sparse/0", photos or {}
    texts = {
        folder / "transforms.json": transforms(cameras, MASKS in photos),
        folder / "cameras.json": gs_cameras(cameras),
    }
    stacks = {folder / form: of for form, of in photos.items()}
    outputs = [model, *texts, *(path.parent for path in stacks)]
    for path in outputs:
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
    for path, of in stacks.items():
        for k, camera in enumerate(cameras):
            with atomic_path(path.parent / path.name.format(camera.name)) as temporary:
                png(of(k), temporary)
    with explained(folder):
        model.mkdir(parents=True)
        colmap_model(cameras, cloud).write_binary(model)
    for path, document in texts.items():
        atomic_write(path, json.dumps(document, indent=1))
    return outputs


def write_capture(folder: Path, capture: Capture, points: Points) -> list[Path]:
    """Write a scene's registered views for other programs to train on: its cameras, undistorted
    photos, points and, where pixels do not count, masks. Returns, raises: as `write_cameras`.
    """
    world = World.read(capture.source)
    poses = world.poses_outward(points.cam_from_world)
    names = file_names([f"{name}.png" for name in points.names])
    cameras = [
        Camera(name, K, pose, *capture.size)
        for name, K, pose in zip(names, points.Ks, poses, strict=True)
    ]
    rows, mask = [capture.names.index(name) for name in points.names], capture.loss_mask
    photos = {IMAGES: lambda k: capture.images[rows[k]]}
    if mask is not None:
        photos[MASKS] = lambda k: np.uint8(255) * mask[rows[k]]
    return write_cameras(
        folder, cameras, replace(points, means=world.outward(points.means)), photos
    )


def file_names(views: list[str]) -> list[str]:
    """A file name for each view: its path without separators, numbered where two coincide."""
    names: list[str] = []
    for view in views:
        name = re.sub(r"[^\w.-]+", "-", view.removesuffix(Path(view).suffix)).strip(".-") or "view"
        name = name.encode()[:200].decode(errors="ignore")
        used_names = {used.lower() for used in names}  # some file systems fold case
        names.append(
            next(
                new
                for k in itertools.count(1)
                if (new := name if k == 1 else f"{name}-{k}").lower() not in used_names
            )
        )
    return names


def colmap_model(cameras: Sequence[Camera], cloud: Points | None) -> pycolmap.Reconstruction:
    """COLMAP's model: a PINHOLE camera for each lens and size, the points and their tracks.

    Choices: binary, as in its text a name ends at a space. A keypoint is where its point projects
      to: what was measured there is not kept.
    """
    model, lenses = pycolmap.Reconstruction(), dict[tuple[float, ...], int]()
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in (() if cloud is None else cloud.means)]
    for index, camera in enumerate(cameras):
        lens = (camera.width, camera.height, *map(float, intrinsics(camera)))
        key = lenses.setdefault(lens, len(lenses) + 1)
        if not model.exists_camera(key):
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE", width=lens[0], height=lens[1], params=lens[2:], camera_id=key
                )
            )
        image = pycolmap.Image(name=f"{camera.name}.png", camera_id=key, image_id=index + 1)
        if cloud is not None:
            visible = np.unique(cloud.tracks[cloud.tracks[:, 1] == index, 0])
            pose = camera.cam_from_world
            rays = (cloud.means[visible] @ pose[:3, :3].T + pose[:3, 3]) @ camera.K.T
            image.points2D = pycolmap.Point2DList(
                [pycolmap.Point2D(xy) for xy in rays[:, :2] / rays[:, 2:]]
            )
            for place, row in enumerate(visible):
                tracks[row].append(pycolmap.TrackElement(index + 1, place))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.cam_from_world[:3]))
    if cloud is not None:
        for position, color, track in zip(cloud.means, cloud.colors, tracks, strict=True):
            model.add_point3D(position, pycolmap.Track(track), color)
    return model


def transforms(cameras: Sequence[Camera], masked: bool) -> dict[str, Any]:
    """nerfstudio's document: camera-to-world in OpenGL's axes, intrinsics by frame; with masks."""
    keys = ("fl_x", "fl_y", "cx", "cy")
    frames = [
        {"file_path": IMAGES.format(camera.name), "w": camera.width, "h": camera.height}
        | ({"mask_path": MASKS.format(camera.name)} if masked else {})
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
