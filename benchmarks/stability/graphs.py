"""Inputs that part the encoder's ONNX graph from torch in float64 (docs/method.md, section 14).

Errors are relative to the largest answer. The plain way takes the first point where nobody is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch

from benchmarks.stability.case import Outcome, beside, case
from benchmarks.stability.inputs import ENCODE, cloud, encoded, encoder, filled, inputs_of, spoiled
from chebsplat.shape.point_encoder import cloud_of
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.shape_models.point_graph import point_model

ANSWERS = 1e-4  # as the stage onnx asks

INPUTS: dict[str, Callable[[], PointInputs]] = ENCODE | {
    "one point": lambda: inputs_of(cloud(1)),
    "two points": lambda: inputs_of(cloud(2)),
    "pairs": lambda: spoiled(lambda of: {"means": of.means[np.arange(60) // 2]}),
    "one neighbour": lambda: _with_neighbors(1),
    "a hundred neighbours, most none": lambda: _with_neighbors(100),
    "own inputs of 1e-30": lambda: spoiled(lambda of: {"own": 1e-30 * of.own}),
    "own inputs of -1e+30": lambda: spoiled(lambda of: {"own": -1e30 * np.abs(of.own)}),
}


def _with_neighbors(count: int) -> PointInputs:
    of = inputs_of(cloud(60))
    room = np.full((*of.neighbors.shape[:2], 100), -1, of.neighbors.dtype)
    room[:, :, : of.neighbors.shape[2]] = of.neighbors
    return of._replace(neighbors=room[:, :, :count])


@cache
def session(attends: bool, size: float) -> tuple[Any, np.ndarray]:
    """The graph of an encoder and of answers of this size, and the map of these."""
    import onnxruntime

    network = encoder(attends)
    answers = (size * np.random.default_rng(0).normal(size=(network.n_features, 6))).astype(
        np.float32
    )
    model = point_model(network, answers).SerializeToString()
    return onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"]), answers


def answered(of: PointInputs, attends: bool, size: float = 1.0) -> Outcome:
    runner, answers = session(attends, size)
    tensors = cloud_of(of)._asdict()
    ours = runner.run(
        None, {entry.name: tensors[entry.name].numpy() for entry in runner.get_inputs()}
    )[0]
    exact = encoded(of, torch.float64, attends) @ answers.astype(np.float64)
    return beside(
        ours, lambda: encoded(filled(of), torch.float32, attends) @ answers, exact, ANSWERS
    )


@case("{kind}, {name}", kind=["attention", "the largest"], name=INPUTS)
def inputs(kind: str, name: str) -> Outcome:
    return answered(INPUTS[name](), kind == "attention")


@case("answers of {size:.0e}", size=[0.0, 1e-30, 1e-10, 1e10, 1e30])
def sizes(size: float) -> Outcome:
    return answered(inputs_of(cloud(60)), True, size)
