"""The region encoder of a trained scene: error against run time of torch, onnxruntime, and onnxruntime in 8 bits.

All regions of the scene are encoded, 256 at a time, on the threads that OMP_NUM_THREADS names. Errors are against torch
in float64: of the encodings, of the fused features, and of the labels that these decode to.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.formats.encoder import DYNAMIC, FLOAT, read_encoder
from chebsplat.formats.gaussians import read_gaussians
from chebsplat.formats.scene import read_scene
from chebsplat.labels.decode import decode_labels
from chebsplat.settings import DescribeSection
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.shape.region_inputs import RegionInputs
from chebsplat.stages.command import n_threads
from chebsplat.stages.encode import CHUNK, gaussians, inputs_of, opened
from chebsplat.stages.onnx import restored_fusion
from chebsplat.stages.restored import trained_with


def chunks(inputs: RegionInputs) -> list[dict[str, np.ndarray]]:
    values = {"inputs": inputs.inputs, "positions": inputs.positions, "mask": inputs.mask}
    return [{k: v[s : s + CHUNK] for k, v in values.items()} for s in range(0, len(inputs.mask), CHUNK)]


def torch_route(encoder: RegionEncoder, parts: list[dict[str, np.ndarray]], dtype: torch.dtype) -> Any:
    tensors = [[torch.from_numpy(v) for v in part.values()] for part in parts]
    tensors = [[v.to(dtype) if v.is_floating_point() else v for v in part] for part in tensors]

    def route() -> np.ndarray:
        with torch.no_grad():
            return np.concatenate([encoder(*part).numpy() for part in tensors])

    return route


def onnx_route(path: Path, parts: list[dict[str, np.ndarray]]) -> Any:
    runner = opened(path)
    return lambda: np.concatenate([runner.run(None, part)[0] for part in parts])


def milliseconds(routes: dict[str, Any], repeats: int) -> dict[str, list[float]]:
    """Times of each route, the routes taking turns so that a busy moment meets all of them."""
    taken: dict[str, list[float]] = {name: [] for name in routes}
    for turn in range(repeats + 1):
        for name, route in routes.items():
            began = time.perf_counter()
            route()
            if turn:  # the first warms up
                taken[name].append(1000 * (time.perf_counter() - began))
    return taken


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("encoder", __doc__, work=True)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args(arguments)
    torch.set_num_threads(n_threads())
    scene, held = read_scene(options.work / "export"), read_encoder(options.work / "onnx")
    settings = held.contract["settings"]
    p, order = gaussians(options.work / "export", None, settings["n_channels"])
    inputs = inputs_of(p, DescribeSection.model_validate(settings["describe"]), settings)
    checkpoint, parts = read_gaussians(options.work / "train"), chunks(inputs)
    single, double = (RegionEncoder.restored(*checkpoint.encoder()) for _ in range(2))
    train = trained_with(arguments.work / "train")["train"]
    double, fusion = double.double(), restored_fusion(checkpoint, settings["n_channels"], train)
    exact = torch_route(double, parts, torch.float64)()
    routes = {
        "torch, float32": torch_route(single, parts, torch.float32),
        "onnxruntime, float32": onnx_route(held.models[FLOAT], parts),
        "onnxruntime, int8": onnx_route(held.models[DYNAMIC], parts),
    }

    def fused(encodings: np.ndarray) -> np.ndarray:
        centers = inputs.regions.centers
        values = (p["raw_features"], encodings.astype(np.float32), inputs.cover, p["means"], p["means"][centers])
        values += (p["quats"][centers], np.exp(p["log_scales"][centers]))
        with torch.no_grad():
            tensors = [torch.from_numpy(v) for v in values]
            return fusion(*tensors, torch.tensor(inputs.regions.radius, dtype=torch.float32))[0].numpy()

    wanted = fused(exact)
    assert scene.label_embeddings is not None
    labels = decode_labels(wanted, scene.label_embeddings)
    taken = milliseconds(routes, options.repeats)
    rows = []
    for name, route in routes.items():
        encodings = route()
        found = fused(encodings)
        rows.append(
            {
                "route": name,
                "milliseconds": f"{np.median(taken[name]):.1f}",
                "fastest": f"{min(taken[name]):.1f}",
                "encodings_error": f"{np.abs(encodings - exact).max():.1e}",
                "fused_error": f"{np.abs(found - wanted).max():.1e}",
                "labels_changed": f"{np.mean(decode_labels(found, scene.label_embeddings) != labels):.4%}",
            }
        )
    shared.write_csv(options.out / "encoder.csv", rows)
    m, n = inputs.mask.shape
    print(f"{m} regions of up to {n} Gaussians, {len(order)} Gaussians, {n_threads()} threads; largest encoding "
          f"{np.abs(exact).max():.2f}")  # fmt: skip
    widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    for row in [dict(zip(widths, widths, strict=True)), *rows]:
        print("  ".join(row[key].ljust(width) for key, width in widths.items()))
    slower = float(rows[1]["milliseconds"]) > float(rows[0]["milliseconds"])
    print(f"bar: onnxruntime at least as fast as torch: {'MISSED' if slower else 'met'}")
