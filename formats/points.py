"""`points/1`: registered cameras, and points with normals and local anisotropic covariances, and swept depth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.cameras import POSES, check_cameras
from chebsplat.formats.documents import TypedDict, read_document, write_document
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.names import check_names
from chebsplat.formats.tensors import FLOAT, Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.points/1"
SPECS: dict[str, Spec] = POSES | {
    "means": (FLOAT, "n", 3),
    "colors": ("uint8", "n", 3),
    "normals": (FLOAT, "n", 3),
    "covariances": (FLOAT, "n", 3, 3),
    "tracks": ("int32 or int64", "t", 2),
}
SWEPT = "swept.safetensors"  # of depths, where photos were swept for it


@dataclass
class Points:
    """Registered views and the points seen by them.

    names:          of the registered views; the others could not be posed.
    Ks:             f64 [V, 3, 3] pixels; cam_from_world: f64 [V, 4, 4].
    means:          f64 [N, 3] scene units; colors: u8 [N, 3]; normals: f32 [N, 3] unit, facing a camera.
    covariances:    f32 [N, 3, 3] of the neighbourhood, scaled to the local spacing (docs/method.md, section 1).
    tracks:         i32 [T, 2] (point, view) observations; empty where points come from depth.
    notes:          how the points came about, reprojection errors, counts.
    depths:         f32 [V, h, w] z that a sweep of the photos, reduced to this size, found; 0: none; None: no sweep.
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
    depths: np.ndarray | None = None


class Document(TypedDict):
    names: list[str]
    notes: dict[str, Any]


def thinned(points: Points, most: int, seed: int) -> Points:
    """At most so many of the points, drawn alike from all and in their order; without the tracks of any."""
    if len(points.means) <= most:
        return points
    kept = np.sort(np.random.default_rng(seed).choice(len(points.means), most, replace=False))
    fewer = {name: getattr(points, name)[kept] for name in ("means", "colors", "normals", "covariances")}
    return replace(points, **fewer, tracks=points.tracks[:0])


def write_points(out: Path, points: Points) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    arrays = {name: getattr(points, name) for name in SPECS}
    write_tensors(out / "points.safetensors", arrays)
    if points.depths is not None:
        write_tensors(out / SWEPT, {"depths": points.depths})
    write_document(out / "points.json", {"names": points.names, "notes": points.notes})


def read_points(path: Path) -> Points:
    """Registered views and points at `path`, all in memory.

    Raises: InputError naming the damaged file and the remedy.
    """
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document, file = read_document(path, manifest, "points.json", Document), path / "points.safetensors"
    names = document["names"]
    check_names(names, "names", path / "points.json", remedy_of(path))
    arrays = read_tensors(path, manifest, file.name, SPECS)
    check_cameras(names, arrays["Ks"], arrays["cam_from_world"], file, remedy_of(path))
    depths = None
    if SWEPT in manifest.files:
        depths = read_tensors(path, manifest, SWEPT, {"depths": ("float32", "v", "h", "w")})["depths"]
        if len(depths) != len(names):
            raise InputError(f"{path / SWEPT} has depth of {len(depths)} views, not {len(names)}; {remedy_of(path)}")
    return Points(names, **{name: arrays[name] for name in SPECS}, notes=document["notes"], depths=depths)
