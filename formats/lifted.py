"""`lifted/2`: features that were lifted to the Gaussians of a checkpoint, and the evidence for
them; `refined/2`: the features after smoothing and knowledge, and how both were chosen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class Lifted(Record):
    """N Gaussians in the order of their checkpoint, C channels of the teacher.

    features:   f32 [N, C]; zero where no training view sees a Gaussian.
    weights:    f32 [N], pixels: Σ α T over all training views.
    n_views:    i32 [N], training views that see it.
    agreement:  f32 [N] in [0, 1]: length of the weighted mean of the views' directions; 1: all say
      the same.
    halves:     f32 [2, N, C], features by each half of the training views; half_views i32 [2, N],
      how many see it.
    notes:      names of the views, in order, and the number of observations.
    """

    SCHEMA: ClassVar[str] = "chebsplat.lifted/2"
    features: Annotated[np.ndarray, Array("float32", ("gaussian", "channel"))]
    weights: Annotated[np.ndarray, Array("float32", ("gaussian",), "pixels")]
    n_views: Annotated[np.ndarray, Array("int32", ("gaussian",), "views")]
    agreement: Annotated[np.ndarray, Array("float32", ("gaussian",))]
    halves: Annotated[np.ndarray, Array("float32", (2, "gaussian", "channel"))]
    half_views: Annotated[np.ndarray, Array("int32", (2, "gaussian"), "views")]
    notes: dict[str, Any] = field(default_factory=dict)


@dataclass
class Refined(Record):
    """N Gaussians in the order of their checkpoint, C channels of the teacher.

    features:   f32 [N, C].
    confidence: f32 [N] in [0, 1], from the number and agreement of votes; 0 without votes.
    notes:      initial features, smoothing, weight of knowledge in views, weight of a view where
      the teacher is unsure of the scene, and labels that the two halves of the training views have
      alike without and with knowledge.
    """

    SCHEMA: ClassVar[str] = "chebsplat.refined/2"
    features: Annotated[np.ndarray, Array("float32", ("gaussian", "channel"))]
    confidence: Annotated[np.ndarray, Array("float32", ("gaussian",))]
    notes: dict[str, Any] = field(default_factory=dict)
