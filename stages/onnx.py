"""onnx: the encoder of shape and the scene's knowledge as one graph, equal to torch's."""

from __future__ import annotations

import json

import numpy as np

from chebsplat.errors import DataFailure
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.knowledge import read_knowledge
from chebsplat.shape.point_encoder import PointEncoder, cloud_of
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.answers import answered, inputs_of
from chebsplat.stages.shape_models.point_graph import point_contract, point_model

ENCODER = "encoder.onnx"
TOLERANCE = 1e-4  # largest difference from torch
N_COMPARED = 2048  # points of the scene, for the comparison


def run(job: Job) -> None:
    """`encoder.onnx`, with the contract of its inputs and outputs (docs/method.md, section 14).

    Reads `knowledge` and `descriptors`. Writes `encoder`.
    Raises: DataFailure where the graph answers otherwise than torch by more than TOLERANCE.
    """
    import onnx
    import onnxruntime

    knowledge = read_knowledge(job.inputs["knowledge"])
    encoder = PointEncoder.restored(knowledge.encoder, knowledge.weights)
    model, contract = point_model(encoder, knowledge.map), point_contract(encoder, knowledge)
    onnx.helper.set_model_props(model, {"chebsplat.contract": json.dumps(contract)})
    path = job.out / ENCODER
    onnx.save(model, path)
    try:
        inputs = inputs_of(
            job.inputs["knowledge"], Descriptors.read(job.inputs["descriptors"]), knowledge
        )
    except DataFailure as error:
        job.left_out("comparison with torch", str(error))
        return
    inputs = first(inputs, N_COMPARED)
    runner = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names, tensors = [entry.name for entry in runner.get_inputs()], cloud_of(inputs)._asdict()
    answers = runner.run(None, {name: tensors[name].numpy() for name in names})[0]
    difference = float(np.abs(answers - answered(knowledge, inputs)).max())
    if not difference <= TOLERANCE:
        raise DataFailure(
            f"{ENCODER} differs from torch by {difference:.1e}, more than "
            f"{TOLERANCE:.1e}; report this"
        )
    job.facts |= {
        "largest_difference": difference,
        "n_compared": len(answers),
        "bytes": path.stat().st_size,
    }


def first(inputs: PointInputs, count: int) -> PointInputs:
    """The first `count` points, and the neighbours that are among them."""
    own, means, normals, descriptors, neighbors = (values[:count] for values in inputs)
    return PointInputs(
        own, means, normals, descriptors, np.where(neighbors < len(own), neighbors, -1)
    )
