"""`model/1`: cameras, poses and points that structure from motion gave photos without poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class PhotoModel(Record):
    """names:   of the registered photos, or of a video's frames, whose numbers are `frames`.
    cameras:    COLMAP's [model, parameters, width, height], in pixels of the upright photos;
      camera: each photo's.
    cam_from_world: f64 [V, 4, 4]; points: f64 [N, 3], colors u8 [N, 3], errors f64 [N] pixels.
    tracks:     i32 [T, 2] (point, photo).
    notes:      sentences for the reader. judged: what the model's trust is read off
      (`stages/reconstruction/judge.py`).
    """

    SCHEMA: ClassVar[str] = "chebsplat.model/1"
    names: list[str]
    cameras: list[list[Any]]
    camera: Annotated[np.ndarray, Array("int32", ("view",))]
    cam_from_world: Annotated[np.ndarray, Array("float64", ("view", 4, 4), "scene units")]
    points: Annotated[np.ndarray, Array("float64", ("point", 3), "scene units")]
    colors: Annotated[np.ndarray, Array("uint8", ("point", 3), "sRGB")]
    errors: Annotated[np.ndarray, Array("float64", ("point",), "pixels")]
    tracks: Annotated[np.ndarray, Array("int32", ("observation", 2), "index of a point, of a view")]
    frames: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    judged: dict[str, Any] = field(default_factory=dict)
