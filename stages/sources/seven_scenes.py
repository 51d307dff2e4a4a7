"""7-Scenes: frame-N.color, .depth and .pose side by side, in one folder or in several seq-*/ of it.

Poses are the depth camera's, and depth is not registered to colour, whose camera stands beside it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.stages.sources import assembly, cameras, common, texts
from chebsplat.stages.sources.common import Frame, Listing

# Of images 640 pixels wide. The data set states the depth camera's focal length alone. The others,
# the photo's focal length, its centre less the image's, and where the depth camera stands in it
# (metres), are those by which edges in the depth of 40 frames of the red kitchen lie on edges of
# the photos: 1.41 times the gradient there of 525 pixels, 0, and one place for both cameras.
DEPTH, COLOR, CENTRE = 585.0, 526.0, np.array([3.1, -3.1])
OFFSET = np.array([-0.0331, 0.0036, 0.0])


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture. `class_names` is of no use here: the data set has no labels."""
    return assembly.assemble(_listing(folder), settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """Reads names only. Where one frame has depth, all must: `read` fails otherwise."""
    depth = any(
        name.endswith(".depth.png")
        for place in _places(folder)
        for name in os.listdir(folder / place)
    )
    return {"poses": True, "depth": depth, "labels": False}


def files(folder: Path) -> list[Path]:
    """The depth camera's intrinsics, and every image, depth and pose."""
    paths = [_intrinsics(folder)]
    for name, image, beside in _frames(folder):
        parts = (image, f"{name}.depth.png", f"{name}.pose.txt")
        paths += [folder / part for part in parts if part in beside]
    return sorted(path for path in paths if path is not None)


def _intrinsics(folder: Path) -> Path | None:
    places = (folder, folder.absolute().parent)
    return next(
        (
            p / "camera-intrinsics.txt"
            for p in places
            if common.present(p / "camera-intrinsics.txt")
        ),
        None,
    )


def _places(folder: Path) -> list[str]:
    """Prefixes of names in the folder itself and in its sequences."""
    sequences = [
        name for name in os.listdir(folder) if name[:4] == "seq-" and (folder / name).is_dir()
    ]
    return ["", *(f"{name}/" for name in sorted(sequences))]


def _frames(folder: Path) -> list[tuple[str, str, set[str]]]:
    """(name, colour image, files of its folder) of the frames, POSIX paths in natural order."""
    frames = []
    for place in _places(folder):
        names = {place + name for name in os.listdir(folder / place)}
        for image in common.printable(folder, filter(is_image, names)):
            name = common.stem(image)
            if name.endswith(".color") and name[len(place) :].startswith("frame-"):
                frames.append((name.removesuffix(".color"), image, names))
    return sorted(frames, key=lambda frame: common.natural(frame[0]))


def _listing(folder: Path) -> Listing:
    frames = _frames(folder)
    if not frames:
        raise InputError(
            f"{folder} holds no frame-*.color.jpg or .png, nor does a seq-*/ in it; "
            "correct source.path"
        )
    (width, height), _ = header(folder / frames[0][1])
    path, image = _intrinsics(folder), folder / frames[0][1]
    focal, centre = COLOR * width / 640, np.array([width, height]) / 2 + CENTRE * width / 640
    camera = cameras.camera_of(image, "PINHOLE", (focal, focal, *centre), width, height)
    K = np.diag([DEPTH * width / 640, DEPTH * width / 640, 1.0, 1.0])
    K[:2, 2] = width / 2, height / 2
    notes = []
    if path is not None:
        K = texts.read_matrix(path)
        notes = texts.skew_note(path, K)
    depth_camera = cameras.camera_of(
        path or image, "PINHOLE", (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), width, height
    )
    beside = f"{1000 * np.linalg.norm(OFFSET):.0f} mm beside the depth camera"
    notes += [f"The colour camera's focal length is taken to be {focal:g} pixels, {beside}."]
    names = [name for name, _, _ in frames]
    matrices = np.array([texts.read_matrix(folder / f"{name}.pose.txt") for name in names])
    poses = cameras.cam_from_world(folder, matrices, [f"{name}.pose.txt" for name in names])
    poses[:, :3, 3] += OFFSET
    has_depth = probe(folder)["depth"]
    listed = [
        Frame(
            name, folder / image, camera, pose, folder / f"{name}.depth.png" if has_depth else None
        )
        for (name, image, _), pose in zip(frames, poses, strict=True)
    ]
    return Listing(
        "seven_scenes", listed, depth_camera=depth_camera, depth_offset=OFFSET, notes=notes
    )
