"""`points/2`: registered cameras, points with covariances, swept depth; PLY point clouds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.ply import read_vertices
from chebsplat.formats.record import Array, Record

MOST = 20_000_000  # points; a room's scan has some hundred thousand
FARTHEST = 1e6  # scene units: beyond, steps of float32 exceed 0.06


@dataclass
class Points(Record):
    """Registered views and the points seen by them.

    names:          of the registered views; the others could not be posed.
    Ks:             f64 [V, 3, 3] pixels; cam_from_world: f64 [V, 4, 4].
    means:          f64 [N, 3] scene units; colors: u8 [N, 3]; normals: f32 [N, 3] unit, facing a
      camera.
    covariances:    f32 [N, 3, 3] of the neighbourhood, scaled to the local spacing (docs/method.md,
      section 1).
    tracks:         i32 [T, 2] (point, view) observations; empty where points come from depth.
    notes:          how the points came about, reprojection errors, counts.
    depths:         f32 [V, h, w] z by plane sweeps of the reduced photos, 0: none; None: no sweep.
    """

    SCHEMA: ClassVar[str] = "chebsplat.points/2"
    names: list[str]
    Ks: Annotated[np.ndarray, Array("float64", ("view", 3, 3), "pixels")]
    cam_from_world: Annotated[np.ndarray, Array("float64", ("view", 4, 4), "scene units")]
    means: Annotated[np.ndarray, Array("float64", ("point", 3), "scene units")]
    colors: Annotated[np.ndarray, Array("uint8", ("point", 3), "sRGB")]
    normals: Annotated[np.ndarray, Array("float32", ("point", 3))]
    covariances: Annotated[np.ndarray, Array("float32", ("point", 3, 3), "scene units squared")]
    tracks: Annotated[np.ndarray, Array("int32", ("observation", 2), "index of a point, of a view")]
    notes: dict[str, Any] = field(default_factory=dict)
    depths: Annotated[
        np.ndarray | None, Array("float32", ("view", "row", "column"), "scene units, z; 0 unknown")
    ] = None


def thinned(points: Points, most: int, seed: int) -> Points:
    """At most `most` of the points, a uniform sample in their order; tracks are dropped."""
    if len(points.means) <= most:
        return points
    rows = np.sort(np.random.default_rng(seed).choice(len(points.means), most, replace=False))
    fewer = {
        name: getattr(points, name)[rows] for name in ("means", "colors", "normals", "covariances")
    }
    return replace(points, **fewer, tracks=points.tracks[:0])


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions f32 [N, 3] and colours u8 [N, 3] or None. Raises InputError naming the file."""
    vertex = read_vertices(path, "restore it: no other points take its place")
    properties = {part.name for part in vertex.properties}
    if not properties.issuperset("xyz"):
        raise InputError(f"{path} has no x, y, z; restore it: no other points take its place")
    if not 0 < len(vertex.data) <= MOST:
        raise InputError(
            f"{path} holds {len(vertex.data)} points; 1 to {MOST} are possible: "
            "restore it, or thin it"
        )
    with np.errstate(over="ignore"):  # of doubles
        points = np.stack([np.asarray(vertex[axis], np.float32) for axis in "xyz"], 1)
    if bad := int((~(np.abs(points) <= FARTHEST).all(1)).sum()):
        raise InputError(
            f"{path} holds {bad} points that are not finite, or farther than {FARTHEST:.0e} units "
            "from the origin; "
            "restore it, or move the scene's origin into the scene"
        )
    channels = ("red", "green", "blue")
    if not properties.issuperset(channels):
        return points, None
    colors = np.stack([np.asarray(vertex[channel]) for channel in channels], 1)
    if colors.dtype != np.uint8:
        raise InputError(f"{path} has colours of type {colors.dtype}, not 8 bits; convert them")
    return points, colors
