"""onnx: export the local encoder and the fusion behind it, and check both against torch at many counts and sizes."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch
from onnxruntime.quantization import QuantType, quantize_dynamic

from chebsplat.errors import DataFailure
from chebsplat.formats.encoder import DYNAMIC, FLOAT, FUSED, write_encoder
from chebsplat.formats.gaussians import Gaussians
from chebsplat.shape.fusion import Fusion, Gate
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.point_graph import contract
from chebsplat.stages.shape_models.region_graph import encoder_model, fusion_model
from chebsplat.stages.training.saves import restored_encoder, trained_with

SIZES = (
    (1, 1),
    (1, 8),
    (3, 1),
    (16, 32),
    (5, 64),
    (300, 16),
)  # (regions, members or Gaussians) that parity is measured at
ENCODER = ("inputs", "positions", "mask")
FUSION = ("features", "encodings", "cover", "means", "centers", "quats", "scales", "radius")


def run(job: Job) -> None:
    """The encoder and the fusion as ONNX graphs (Eqs 7-10), and how far they lie from torch.

    Reads `gaussians`. Writes `encoder`.
    """
    path = job.inputs["gaussians"]
    gaussians = Gaussians.read(path)
    encoder = restored_encoder(gaussians)
    config = trained_with(path)
    fusion = restored_fusion(gaussians, encoder.n_channels, config["train"])
    agreed = contract(encoder, config)
    onnx.save(encoder_model(encoder), job.out / FLOAT)
    onnx.save(fusion_model(fusion), job.out / FUSED)
    quantize(job.out / FLOAT, job.out / DYNAMIC)
    for name in (FLOAT, FUSED, DYNAMIC):
        annotate(job.out / name, agreed)
    parity: dict[str, list[dict[str, Any]]] = {FLOAT: [], FUSED: [], DYNAMIC: []}
    for size in SIZES:
        given, behind = example(encoder, *size), fusion_example(encoder.n_channels, *size)
        for name, module, values in ((FLOAT, encoder, given), (FUSED, fusion, behind), (DYNAMIC, encoder, given)):
            parity[name].append({"sizes": size, "difference": compare(module, job.out / name, values)})
    worst = max(row["difference"] for name in (FLOAT, FUSED) for row in parity[name])
    if not worst <= job.config.onnx.tolerance:
        raise DataFailure(f"ONNX differs from torch by {worst:.1e}; onnx.tolerance is {job.config.onnx.tolerance:.1e}")
    job.facts |= {
        "largest_difference": worst,
        "largest_difference_int8": max(row["difference"] for row in parity[DYNAMIC]),
    }
    write_encoder(job.out, agreed, parity)


def restored_fusion(gaussians: Any, n_channels: int, train: dict[str, Any]) -> Any:
    """`fusion.Fusion` with the checkpoint's gate; train: the section that it was trained with."""
    prefix, gate = "shape.gate.", Gate(n_channels)
    gate.load_state_dict(
        {k.removeprefix(prefix): torch.from_numpy(v) for k, v in gaussians.modules.items() if k.startswith(prefix)}
    )
    return Fusion(gate, train["inflation"], train["temperature"]).eval()


def example(encoder: Any, n_regions: int, n_members: int, seed: int = 0) -> dict[str, Any]:
    """Random inputs of a size; the last member of every second region is padding."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.ones(n_regions, n_members, dtype=torch.bool)
    if n_members > 1:
        mask[::2, -1] = False
    return {
        "inputs": torch.randn(n_regions, n_members, encoder.n_inputs, generator=generator),
        "positions": 2 * torch.rand(n_regions, n_members, encoder.n_positions, generator=generator) - 1,
        "mask": mask,
    }


def fusion_example(n_channels: int, n_regions: int, n_gaussians: int, seed: int = 0) -> dict[str, Any]:
    """Random inputs of a size; every third Gaussian is covered by nothing, every second by fewer regions than fit."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    cover = torch.randint(n_regions, (n_gaussians, 4), generator=generator)
    cover[1::2, 2:] = -1
    cover[2::3] = -1
    n, m = n_gaussians, n_regions
    values = (normal(n, n_channels), normal(m, n_channels), cover, normal(n, 3), normal(m, 3), normal(m, 4))
    return dict(zip(FUSION, (*values, normal(m, 3).exp(), torch.tensor(1.5)), strict=True))


def quantize(source: Path, target: Path) -> None:
    """Weights in 8 bits, activations quantised as they come.

    Choices: both unsigned. Sums of signed weights saturate where a processor has AVX2 without VNNI: the error is then
      two thirds of the answer, and a fifteenth with these.
    """
    model = onnx.load(source)
    del model.graph.value_info[:]  # shapes of before: the quantiser transposes weights and then finds them wrong
    logging.disable(logging.WARNING)  # "please consider pre-processing", by the root logger
    try:
        quantize_dynamic(model, target, weight_type=QuantType.QUInt8, per_channel=True)
    finally:
        logging.disable(logging.NOTSET)


def annotate(path: Path, agreed: dict[str, Any]) -> None:
    """Put the contract into the model's own metadata."""
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"chebsplat.contract": json.dumps(agreed)})
    onnx.save(model, path)


def compare(module: Any, path: Path, given: dict[str, Any]) -> float:
    """Largest absolute difference between onnxruntime and torch."""
    runner = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    outputs = runner.run(None, {name: value.numpy() for name, value in given.items()})
    with torch.no_grad():
        wanted = module(*given.values())
    pairs = zip(outputs, wanted if isinstance(wanted, tuple) else (wanted,), strict=True)
    return max(float((torch.from_numpy(a) - b).abs().max()) for a, b in pairs)
