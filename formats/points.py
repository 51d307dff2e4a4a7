"""`points/2`: registered cameras, and points with normals and local anisotropic covariances, and swept depth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class Points(Record):
    """Registered views and the points seen by them.

    names:          of the registered views; the others could not be posed.
    Ks:             f64 [V, 3, 3] pixels; cam_from_world: f64 [V, 4, 4].
    means:          f64 [N, 3] scene units; colors: u8 [N, 3]; normals: f32 [N, 3] unit, facing a camera.
    covariances:    f32 [N, 3, 3] of the neighbourhood, scaled to the local spacing (docs/method.md, section 1).
    tracks:         i32 [T, 2] (point, view) observations; empty where points come from depth.
    notes:          how the points came about, reprojection errors, counts.
    depths:         f32 [V, h, w] z that a sweep of the photos, reduced to this size, found; 0: none; None: no sweep.
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
    depths: Annotated[np.ndarray | None, Array("float32", ("view", "row", "column"), "scene units, z; 0 unknown")] = (
        None
    )


def thinned(points: Points, most: int, seed: int) -> Points:
    """At most so many of the points, drawn alike from all and in their order; without the tracks of any."""
    if len(points.means) <= most:
        return points
    kept = np.sort(np.random.default_rng(seed).choice(len(points.means), most, replace=False))
    fewer = {name: getattr(points, name)[kept] for name in ("means", "colors", "normals", "covariances")}
    return replace(points, **fewer, tracks=points.tracks[:0])
