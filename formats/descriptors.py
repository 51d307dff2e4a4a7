"""`descriptors/2`: points of a scene's surface and the shape about each, the encoder's input."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class Descriptors(Record):
    """N points; their frame is the scene's turned upright, z up, in metres, about `origin`.

    own, means, normals, descriptors, neighbors: as in `shape.point_inputs.PointInputs`.
    origin: [3] scene units; up: [3] against gravity, in the scene's frame; unit: scene units in a
      metre.
    notes:  source of the surface, certainty of up, origin of the unit; the reason if there is no
      point.
    """

    SCHEMA: ClassVar[str] = "chebsplat.descriptors/2"
    own: Annotated[
        np.ndarray,
        Array("float32", ("point", "number"), "metres, none, none, none, none, log of metres"),
    ]
    means: Annotated[np.ndarray, Array("float32", ("point", 3), "metres")]
    normals: Annotated[np.ndarray, Array("float32", ("point", 3))]
    descriptors: Annotated[np.ndarray, Array("float32", ("point", "value"))]
    neighbors: Annotated[
        np.ndarray, Array("int32", ("point", "radius", "neighbor"), "index of a point, -1 none")
    ]
    origin: list[float]
    up: list[float]
    unit: float
    notes: dict[str, Any] = field(default_factory=dict)
