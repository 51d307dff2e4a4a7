"""`capture/1`: what was photographed. Images and cameras; depth, labels and loss masks where the source has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, has_array, open_array, write_array
from chebsplat.formats.cameras import POSES, check_cameras
from chebsplat.formats.documents import TypedDict, read_document, write_document
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.names import check_names
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.capture/1"
OPTIONAL = {
    "depth": ("float32", ("view", "row", "column"), "scene units, z-depth, nan where unknown"),
    "labels": ("int16", ("view", "row", "column"), "class index, -1 ignored"),
    "pseudo_labels": ("int16", ("view", "row", "column"), "class index that a 2D network gave, -1 none"),
    "confidence": ("float16", ("view", "row", "column"), "of the pseudo labels, 0 to 1"),
    "loss_mask": ("bool", ("view", "row", "column"), "true where a pixel counts"),
}
Stack = np.ndarray | StoredArray


@dataclass
class Capture:
    """V views of one size H x W.

    names:          unique per view; every join between artifacts is on these, never on position.
    images:         u8 [V, H, W, 3].
    Ks:             f64 [V, 3, 3] pixels, pixel centres at half integers (COLMAP).
    cam_from_world: f64 [V, 4, 4] OpenCV axes, or None where poses are unknown.
    is_test:        bool [V]; test views are never trained on.
    depth, labels, pseudo_labels, confidence, loss_mask: as in OPTIONAL, or None. class_names[labels] names a pixel.
    points:         f32 [N, 3] in the world, where the source has its own, with point_colors u8 [N, 3] or None, and
                    tracks i32 [T, 2] (point, view), who sees them, or None.
    source:         which source, and notes about what was dropped or changed; protocol: name and parameters.
    """

    names: list[str]
    images: Stack
    Ks: np.ndarray
    cam_from_world: np.ndarray | None
    is_test: np.ndarray
    depth: Stack | None = None
    labels: Stack | None = None
    loss_mask: Stack | None = None
    class_names: list[str] | None = None
    source: dict[str, Any] = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    pseudo_labels: Stack | None = None
    confidence: Stack | None = None
    tracks: np.ndarray | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.images.shape[2], self.images.shape[1]


class Document(TypedDict):
    names: list[str]
    class_names: list[str] | None
    source: dict[str, Any]
    protocol: dict[str, Any]


def write_capture(out: Path, capture: Capture) -> None:
    """Fill the directory that `artifact.publish` yields. Raises InputError if the views do not fit together."""
    _check(capture, "capture", "correct the source")
    write_array(out / "images", np.asarray(capture.images), ("view", "row", "column", "channel"), "sRGB")
    for name, (dtype, dimensions, units) in OPTIONAL.items():
        data = getattr(capture, name)
        if data is not None:
            write_array(out / name, np.asarray(data).astype(dtype, copy=False), dimensions, units)
    cameras = {"Ks": capture.Ks, "is_test": capture.is_test.astype(np.uint8)}
    if capture.cam_from_world is not None:
        cameras["cam_from_world"] = capture.cam_from_world
    write_tensors(out / "cameras.safetensors", cameras)
    if capture.points is not None:
        beside = {"colors": capture.point_colors, "tracks": capture.tracks}
        given = {name: values for name, values in beside.items() if values is not None}
        write_tensors(out / "points.safetensors", {"points": capture.points} | given)
    write_document(
        out / "capture.json",
        {
            "names": capture.names,
            "class_names": capture.class_names,
            "source": capture.source,
            "protocol": capture.protocol,
        },
    )


def read_capture(path: Path) -> Capture:
    """The capture at `path`; images, depth, labels and masks stay on disk until indexed.

    Raises: InputError naming the damaged file and the remedy.
    """
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document = read_document(path, manifest, "capture.json", Document)
    cameras = read_tensors(path, manifest, "cameras.safetensors", {"Ks": POSES["Ks"], "is_test": ("uint8", "v")})
    images = open_array(path, manifest, "images", (len(document["names"]), None, None, 3), "uint8")
    last = len(document["class_names"] or []) - 1
    within = {"labels": (-1, last), "pseudo_labels": (-1, last), "confidence": (0, 1)}
    optional = {
        name: open_array(path, manifest, name, images.shape[:3], dtype, within.get(name))
        for name, (dtype, _, _) in OPTIONAL.items()
        if has_array(manifest, name)
    }
    cloud = {}
    if "points.safetensors" in manifest.files:
        cloud = read_tensors(path, manifest, "points.safetensors", {"points": ("float32", "n", 3)})
    capture = Capture(
        document["names"],
        images,
        cameras["Ks"],
        cameras.get("cam_from_world"),
        cameras["is_test"].astype(bool),
        **optional,
        class_names=document["class_names"],
        points=cloud.get("points"),
        point_colors=cloud.get("colors"),
        tracks=cloud.get("tracks"),
        source=document["source"],
        protocol=document["protocol"],
    )
    _check(capture, str(path), remedy_of(path))
    return capture


def _check(capture: Capture, where: str, remedy: str) -> None:
    n, poses = len(capture.names), capture.cam_from_world
    check_names(capture.names, "view names", where, remedy)
    if capture.class_names is not None:
        check_names(capture.class_names, "class names", where, remedy)
    for name in ("images", "Ks", "is_test", "cam_from_world", *OPTIONAL):
        data = getattr(capture, name)
        if data is not None and len(data) != n:
            raise InputError(f"{where}: {len(data)} {name} for {n} views; {remedy}")
    for name in OPTIONAL:
        data = getattr(capture, name)
        if data is not None and tuple(data.shape) != tuple(capture.images.shape[:3]):
            raise InputError(f"{where}: {name} is {data.shape}, images are {capture.images.shape}; {remedy}")
    if (capture.labels is not None or capture.pseudo_labels is not None) and not capture.class_names:
        raise InputError(f"{where}: labels without class names; name them in scene.json or labels.json")
    if (poses is not None and poses.shape[1:] != (4, 4)) or capture.Ks.shape[1:] != (3, 3):
        raise InputError(f"{where}: cameras are no matrices 3x3 and 4x4; {remedy}")
    check_cameras(capture.names, capture.Ks, poses, where, remedy)
    points, colors = capture.points, capture.point_colors
    if points is not None and colors is not None and (colors.shape != points.shape or colors.dtype != np.uint8):
        raise InputError(f"{where}: points {points.shape} with colours {colors.dtype} {colors.shape}; {remedy}")
    tracks = capture.tracks
    if points is not None and tracks is not None:
        fits = tracks.ndim == 2 and tracks.shape[1] == 2 and tracks.dtype == np.int32
        if not fits or (len(tracks) and (tracks.min() < 0 or (tracks.max(0) >= (len(points), n)).any())):
            raise InputError(f"{where}: tracks {tracks.dtype} {tracks.shape} of {len(points)} points; {remedy}")
