"""encode: features of the shape about each point, by the shipped transformers (Eq 7)."""

from __future__ import annotations

import numpy as np
import torch

from chebsplat.errors import DataFailure
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.knowledge import read_knowledge
from chebsplat.kernels.threads import n_threads
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.answers import inputs_of


def run(job: Job) -> None:
    """Encode the shape about each described point (docs/method.md, section 14).

    Reads `descriptors`, and the encoder of the `knowledge` that ships. Writes `encoding`. It is of
    no point where there are no descriptors.
    Choices: half precision, whose error is a hundredth of the difference between points' features.
    """
    start = read_knowledge(job.inputs["start"])
    descriptors = Descriptors.read(job.inputs["descriptors"])
    torch.set_num_threads(n_threads())
    try:
        inputs = inputs_of(job.inputs["start"], descriptors, start)
    except DataFailure as error:
        job.left_out("knowledge of shape", str(error))
        Encoding(np.zeros((0, len(start.map)), np.float16), {"none": str(error)}).write(job.out)
        return
    features = PointEncoder.restored(start.encoder, start.weights).encode(inputs)
    stored = features.astype(np.float16)
    lost, spread = np.square(stored - features).mean(), features.var(0).mean()
    job.facts |= {"n_points": len(features), "n_features": features.shape[1]}
    job.facts["rounding"] = float(np.sqrt(lost / max(spread, 1e-30)))
    Encoding(stored).write(job.out)
