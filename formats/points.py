"""`points/1`: registered cameras, and points with normals and local anisotropic covariances."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.documents import read_document, write_document
from chebsplat.formats.tensors import Shape, read_tensors, write_tensors

SCHEMA = "chebsplat.points/1"
SHAPES: dict[str, Shape] = {
    "Ks": ("v", 3, 3),
    "cam_from_world": ("v", 4, 4),
    "means": ("n", 3),
    "colors": ("n", 3),
    "normals": ("n", 3),
    "covariances": ("n", 3, 3),
}


@dataclass
class Points:
    """Registered views and the points seen by them.

    names:          of the registered views; the others could not be posed.
    Ks:             f64 [V, 3, 3] pixels; cam_from_world: f64 [V, 4, 4].
    means:          f64 [N, 3] scene units; colors: u8 [N, 3]; normals: f32 [N, 3] unit, facing a camera.
    covariances:    f32 [N, 3, 3] of the neighbourhood, scaled to the local spacing (docs/method.md, section 1).
    tracks:         i32 [T, 2] (point, view) observations; empty where points come from depth.
    notes:          how the points came about, reprojection errors, counts.
    """

    names: list[str]
    Ks: np.ndarray
    cam_from_world: np.ndarray
    means: np.ndarray
    colors: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray
    tracks: np.ndarray
    notes: dict[str, Any] = field(default_factory=dict)


def write_points(out: Path, points: Points) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    arrays = {name: getattr(points, name) for name in (*SHAPES, "tracks")}
    write_tensors(out / "points.safetensors", arrays)
    write_document(out / "points.json", {"names": points.names, "notes": points.notes})


def read_points(path: Path) -> Points:
    """Raises: InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document = read_document(path, manifest, "points.json", ("names", "notes"))
    shapes = SHAPES | {"Ks": (len(document["names"]), 3, 3), "tracks": ("t", 2)}
    arrays = read_tensors(path, manifest, "points.safetensors", shapes)
    return Points(document["names"], **{name: arrays[name] for name in shapes}, notes=document["notes"])
