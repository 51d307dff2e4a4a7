"""The trained encoder as ONNX: any size that is a multiple, weights stored as float16, computed in float32."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from chebsplat.teachers.network import MULTIPLE, Encoder

OPSET = 18
HALVED = 512  # numbers a constant must have to be stored as float16
TOML = """\
# How embedded.onnx is run; written by `make teacher`.
name = "embedded"
output = "features"
mean = {mean}
std = {std}
multiple = {multiple}
labels = "embedded.npz"
text = "minilm"
"""


def export(encoder: Encoder, out: Path, mean: tuple[float, ...], std: tuple[float, ...]) -> Path:
    """Writes out/embedded.onnx and out/embedded.toml; gives the path of the first."""
    rows, columns = torch.export.Dim("rows", min=2, max=256), torch.export.Dim("columns", min=2, max=256)
    program = torch.onnx.export(
        encoder.eval(),
        (torch.zeros(1, 3, 6 * MULTIPLE, 8 * MULTIPLE),),
        dynamo=True,
        opset_version=OPSET,
        input_names=["image"],
        output_names=["features"],
        dynamic_shapes=({2: MULTIPLE * rows, 3: MULTIPLE * columns},),
        verbose=False,
    )
    assert program is not None
    path = out / "embedded.onnx"
    program.save(str(path), external_data=False)
    _halve(path)
    text = TOML.format(mean=list(mean), std=list(std), multiple=MULTIPLE)
    (out / "embedded.toml").write_text(text)
    return path


def _halve(path: Path) -> None:
    """Store the large constants as float16, each behind a cast that onnxruntime folds when it loads the model."""
    model: Any = onnx.load(str(path))
    casts = []
    for constant in model.graph.initializer:
        values = numpy_helper.to_array(constant)
        if values.dtype == np.float32 and values.size >= HALVED:
            name = constant.name
            constant.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.f16"))
            casts.append(helper.make_node("Cast", [f"{name}.f16"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    del model.graph.value_info[:]
    forget_origin(model)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def forget_origin(model: Any) -> None:
    """Take out what the exporter notes of the code that made a model: paths of this machine, no two alike."""
    for entry in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        del entry.metadata_props[:]
        entry.doc_string = ""
