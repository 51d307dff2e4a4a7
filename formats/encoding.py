"""`encoding/1`: features of the shape about each point of a scene's surface."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class Encoding(Record):
    """features: f16 [N, p] of the points of a `descriptors` artifact, in their order; the last is
    1.
    notes: the reason if there is no point.
    """

    SCHEMA: ClassVar[str] = "chebsplat.encoding/1"
    features: Annotated[np.ndarray, Array("float16", ("point", "feature"))]
    notes: dict[str, Any] = field(default_factory=dict)
