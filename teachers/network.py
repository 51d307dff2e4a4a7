"""The encoder: a residual U-Net without its first level, and a fixed linear map into the space of
the text; and it in ONNX, of any size that is a multiple, weights stored as float16, computed in
float32.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F

RANK = 32  # channels before the linear map; see README.md for how it was chosen
MULTIPLE = 16  # sides of an image must be a multiple of it
STRIDE = 2  # of the output
WIDTHS = (16, 48, 96, 128)  # channels at 1/2, 1/4, 1/8 and 1/16 of the resolution
DEPTHS = (0, 1, 2, 5)  # residual blocks there
DILATIONS = (1, 2, 4)  # in turn at 1/16: the receptive field covers 320 x 240
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


class Residual(nn.Module):
    def __init__(self, channels: int, dilation: int):
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )
        # a block begins as the identity
        nn.init.zeros_(self.body[-1].weight)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.body(x), inplace=True)


def _step(inward: int, outward: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Convolution, normalisation, ReLU; kernel 4 at stride 2 keeps cells centred on the pixels."""
    conv = nn.Conv2d(inward, outward, kernel, stride, padding=1 if kernel > 1 else 0, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outward), nn.ReLU(inplace=True))


class Trunk(nn.Module):
    """Images [B, 3, H, W], normalised by mean and std, to unit vectors [B, RANK, H/2, W/2]."""

    def __init__(self) -> None:
        super().__init__()
        self.down, self.levels = nn.ModuleList(), nn.ModuleList()
        for level, (inward, outward) in enumerate(pairwise((3, *WIDTHS))):
            self.down.append(_step(inward, outward, 4, 2))
            turns = DILATIONS if level == len(WIDTHS) - 1 else (1,)
            blocks = [Residual(outward, turns[k % len(turns)]) for k in range(DEPTHS[level])]
            self.levels.append(nn.Sequential(*blocks))
        self.overview = nn.Conv2d(WIDTHS[-1], WIDTHS[-1], 1)
        self.narrow = nn.ModuleList(_step(w, n, 1) for n, w in pairwise(WIDTHS))
        self.merge = nn.ModuleList(_step(w, w, 3) for w in WIDTHS[:-1])
        self.head, self.detail = nn.Conv2d(WIDTHS[1], RANK, 1), nn.Conv2d(WIDTHS[0], RANK, 1)

    def forward(self, images: Tensor) -> Tensor:
        x, skips = images, []
        for down, blocks in zip(self.down, self.levels, strict=True):
            x = blocks(down(x))
            skips.append(x)
        x = x + self.overview(x.mean((2, 3), keepdim=True))
        for level in (2, 1):
            x = self.merge[level](_twice(self.narrow[level](x)) + skips[level])
        fine = self.merge[0](_twice(self.narrow[0](x)) + skips[0])
        return F.normalize((_twice(self.head(x)) + self.detail(fine)).float(), dim=1, eps=1e-6)


def _twice(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


class Encoder(nn.Module):
    """The trunk and the linear map [C, RANK] with orthonormal columns: unit vectors [B, C, H/2,
    W/2].

    Choices: vectors are of unit length inside the graph, so all pixels weigh the same in averages
      and in `channels`; the map is fixed (`span`), so the features' rank is RANK and a map to as
      many channels is exact.
    """

    basis: Tensor

    def __init__(self, trunk: Trunk, basis: Tensor):
        super().__init__()
        self.trunk = trunk
        self.register_buffer("basis", basis[:, :, None, None].clone())

    def forward(self, images: Tensor) -> Tensor:
        return F.conv2d(self.trunk(images), self.basis)


def span(embeddings: Tensor, rank: int = RANK) -> Tensor:
    """Orthonormal columns [C, rank] that hold most of the energy of embeddings [L, C]."""
    basis = torch.linalg.svd(embeddings.double(), full_matrices=False).Vh[:rank].T
    return (basis * torch.sign(basis.sum(0))).float()  # a singular vector's sign is free


def export(encoder: Encoder, out: Path, mean: tuple[float, ...], std: tuple[float, ...]) -> Path:
    """Writes out/embedded.onnx and out/embedded.toml; gives the path of the first."""
    rows, columns = (
        torch.export.Dim("rows", min=2, max=256),
        torch.export.Dim("columns", min=2, max=256),
    )
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
    """Store large constants as float16, each behind a cast that onnxruntime folds on loading."""
    model: Any = onnx.load(str(path))
    casts = []
    for constant in model.graph.initializer:
        values = numpy_helper.to_array(constant)
        if values.dtype == np.float32 and values.size >= HALVED:
            name = constant.name
            constant.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.f16"))
            casts.append(
                helper.make_node("Cast", [f"{name}.f16"], [name], to=onnx.TensorProto.FLOAT)
            )
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    del model.graph.value_info[:]
    forget_origin(model)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def forget_origin(model: Any) -> None:
    """Delete the exporter's notes of the code that made a model: paths of one machine."""
    for entry in (
        model.graph,
        *model.graph.node,
        *model.graph.value_info,
        *model.graph.input,
        *model.graph.output,
    ):
        del entry.metadata_props[:]
        entry.doc_string = ""
