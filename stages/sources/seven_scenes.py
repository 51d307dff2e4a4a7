"""7-Scenes: frame-N.color, .depth and .pose side by side, in one folder or in several seq-*/ of it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import assembly, common
from chebsplat.stages.sources.common import Frame, Listing

FOCAL = 585.0  # pixels of a 640x480 image: what the data set's authors state
UNKNOWN = (0, 65_535)  # stored depths that mean "none": of the copies with cleaned depth, and of the authors' own


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture. `class_names` is of no use here: the data set has no labels."""
    return assembly.assemble(_listing(folder), settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """Light: reads names only. What some frame has, every frame must have: `read` fails otherwise."""
    depth = any(name.endswith(".depth.png") for place in _places(folder) for name in os.listdir(folder / place))
    return {"poses": True, "depth": depth, "labels": False}


def files(folder: Path) -> list[Path]:
    """Intrinsics, and every image, depth and pose."""
    found = [_intrinsics(folder)]
    for name, image, beside in _frames(folder):
        parts = (image, f"{name}.depth.png", f"{name}.pose.txt")
        found += [folder / part for part in parts if part in beside]
    return sorted(path for path in found if path is not None)


def _intrinsics(folder: Path) -> Path | None:
    places = (folder, folder.absolute().parent)
    return next((p / "camera-intrinsics.txt" for p in places if (p / "camera-intrinsics.txt").is_file()), None)


def _places(folder: Path) -> list[str]:
    """The folder itself and its sequences, as they precede the names of what they hold."""
    return [
        "",
        *sorted(f"{entry.name}/" for entry in os.scandir(folder) if entry.is_dir() and entry.name[:4] == "seq-"),
    ]


def _frames(folder: Path) -> list[tuple[str, str, set[str]]]:
    """(name, colour image, files of its folder) of each frame, as POSIX paths below the folder, in natural order."""
    frames = []
    for place in _places(folder):
        found = {place + name for name in os.listdir(folder / place)}
        for image in found:
            name = common.stem(image)
            if common.is_image(image) and name.endswith(".color") and name[len(place) :].startswith("frame-"):
                frames.append((name.removesuffix(".color"), image, found))
    return sorted(frames, key=lambda frame: common.natural(frame[0]))


def _listing(folder: Path) -> Listing:
    frames = _frames(folder)
    if not frames:
        raise InputError(f"{folder} holds no frame-*.color.jpg or .png, nor does a seq-*/ in it; correct source.path")
    (width, height), _ = common.header(folder / frames[0][1])
    intrinsics, notes = _intrinsics(folder), []
    if intrinsics is None:
        fx = fy = FOCAL * width / 640
        cx, cy = width / 2, height / 2
        notes.append(f"There is no camera-intrinsics.txt; the focal length is the data set's {fx:g} pixels.")
        intrinsics = folder / frames[0][1]
    else:
        K = common.read_matrix(intrinsics)
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    camera = common.camera_of(intrinsics, "PINHOLE", (fx, fy, cx, cy), width, height)
    names = [name for name, _, _ in frames]
    matrices = np.array([common.read_matrix(folder / f"{name}.pose.txt") for name in names])
    poses = common.cam_from_world(folder, matrices, [f"{name}.pose.txt" for name in names])
    has_depth = probe(folder)["depth"]
    listed = [
        Frame(name, folder / image, camera, pose, folder / f"{name}.depth.png" if has_depth else None)
        for (name, image, _), pose in zip(frames, poses, strict=True)
    ]
    return Listing("seven_scenes", listed, no_depth=UNKNOWN, notes=notes)
