"""`refined/2`: the features of a finished scene after smoothing and knowledge, and how both were chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class Refined(Record):
    """N Gaussians in the order of their checkpoint, C channels of the teacher.

    features:   f32 [N, C].
    confidence: f32 [N] in [0, 1]: how many votes there are and how far they agree; 0 where nothing is known.
    notes:      what it started from, whether it was smoothed, views that knowledge counts for, what a view counts for
                where the teacher is unsure of the scene, and by smoothing and strength the agreement of half the
                training views with the other half.
    """

    SCHEMA: ClassVar[str] = "chebsplat.refined/2"
    features: Annotated[np.ndarray, Array("float32", ("gaussian", "channel"))]
    confidence: Annotated[np.ndarray, Array("float32", ("gaussian",))]
    notes: dict[str, Any] = field(default_factory=dict)
