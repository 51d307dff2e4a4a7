"""Fused features of a finished scene, by onnxruntime: the encoder's contract, kept without torch."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.encoder import DYNAMIC, FLOAT, FUSED, read_encoder
from chebsplat.formats.files import atomic_path
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import Scene
from chebsplat.formats.tensors import finite32, read_npy
from chebsplat.settings import DescribeSection
from chebsplat.shape.region_inputs import RegionInputs, Tokens, region_inputs
from chebsplat.stages.runtime.command import n_threads
from chebsplat.stages.runtime.config import checked
from chebsplat.stages.teacher_models.onnx_session import CUDA, GPU_REMEDY, Model, providers

CHUNK = 256  # regions that the encoder sees at once


def encode(scene: Path, encoder: Path, features: Path | None, out: Path, device: str = "cpu") -> dict[str, Any]:
    """Describe the regions of a scene, encode them, fuse, and write a .npz.

    Args:
      scene:    a `scene` artifact, or a 3DGS PLY.
      encoder:  an `encoder` artifact, or the float or quantised model in one.
      features: .npy [N, C] that encoder and gate see, for a PLY, which holds none.
      out:      holds fused, gate f32 [N, C], encodings f32 [M, C], centers i64 [M], members i64 [M, n] (-1: padding)
                and radius; Gaussians are numbered as in the scene's files.
      device:   cpu, or cuda, which onnxruntime must have.
    Returns: counts, and seconds of each part.
    Raises:  ConfigError, InputError: arguments that do not fit one another, each named with the remedy.
    """
    if device == "cuda" and CUDA not in providers(device):
        raise ConfigError(f"onnxruntime here has no CUDA: {GPU_REMEDY}, or encode with --device cpu")
    name = FLOAT if encoder.is_dir() else encoder.name
    if name not in (FLOAT, DYNAMIC):
        raise ConfigError(f"{encoder} is neither an onnx artifact nor its {FLOAT} or {DYNAMIC}; pass one of these")
    folder = encoder if encoder.is_dir() else encoder.parent
    held = read_encoder(folder)
    settings = held.contract["settings"]
    file = f"{folder / 'contract.json'}: settings.describe"
    describe = checked(DescribeSection, settings["describe"], file, InputError)
    p, order = gaussians(scene, features, settings["n_channels"])
    began = time.perf_counter()
    try:
        inputs = inputs_of(p, describe, settings)
    except ValueError as error:
        raise InputError(f"{scene} cannot be encoded: {error}") from None
    described = time.perf_counter()
    encodings = encoded(held.models[name], inputs, device)
    done = time.perf_counter()
    centers = inputs.regions.centers
    fused, gate = opened(held.models[FUSED], device).run(
        {
            "features": p["raw_features"],
            "encodings": encodings,
            "cover": inputs.cover,
            "means": p["means"],
            "centers": p["means"][centers],
            "quats": p["quats"][centers],
            "scales": np.exp(p["log_scales"][centers]),
            "radius": np.array(inputs.regions.radius, np.float32),
        },
    )
    if any(values.shape != p["raw_features"].shape for values in (fused, gate)):
        raise InputError(f"{held.models[FUSED]} is of another scene's encoder; {remedy_of(folder)}")
    finished = time.perf_counter()
    row_in_file = np.argsort(order)  # of each Gaussian in the scene's files
    members = inputs.regions.members
    result = {"fused": fused[order], "gate": gate[order], "encodings": encodings, "centers": row_in_file[centers]}
    result |= {"members": np.where(members >= 0, row_in_file[members], -1), "radius": np.float64(inputs.regions.radius)}
    write(out, result)
    seconds = {"describing": described - began, "encoding": done - described, "fusing": finished - done}
    return {"gaussians": len(order), "regions": len(centers)} | {f"{k} s": round(v, 3) for k, v in seconds.items()}


def inputs_of(p: dict[str, np.ndarray], describe: DescribeSection, settings: dict[str, Any]) -> RegionInputs:
    """What the models are fed with of raw parameters; settings: of the contract. Raises as `region_inputs`."""
    return region_inputs(
        p["means"],
        p["quats"],
        p["log_scales"],
        p["raw_features"],
        describe,
        Tokens(settings["n_covers"], settings["described"], settings["context"], settings.get("position", "region")),
    )


def gaussians(scene: Path, features: Path | None, n_channels: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Raw parameters and `raw_features` in the order of training, and each one's row there by row in the file."""
    if scene.is_dir():
        if features is not None:
            raise ConfigError(f"{scene} holds its own features; --features is for a PLY")
        held = Scene.read(scene)
        if "raw_features" not in held.parameters:
            raise InputError(f"{scene} was trained without an encoder; train it with train.encoder = transformer")
        back = np.argsort(held.order)
        p, order = {name: values[back] for name, values in held.parameters.items()}, held.order
    else:
        p = read_ply(scene)[0]
        order = np.arange(len(p["means"]))
        if features is None:
            raise ConfigError(f"{scene} is a PLY, which holds no features; add --features FILE.npy, or pass a scene")
        p["raw_features"] = read_features(features, len(order))
    width = p["raw_features"].shape[1]
    if width != n_channels:
        raise InputError(f"{features or scene} has {width} feature channels, the encoder {n_channels}; pass its own")
    return p, order


def read_features(path: Path, n: int) -> np.ndarray:
    """Features f32 [N, C]. Raises InputError if the file holds anything else."""
    held = read_npy(path, f"save a float32 array [{n}, C]")
    values = finite32(held)
    if values is None or values.ndim != 2 or len(values) != n:
        raise InputError(
            f"{path} is {held.dtype} {held.shape}, not a finite array [{n}, C], one row a Gaussian; save one"
        )
    return values


def opened(path: Path, device: str) -> Model:
    """A model; on the CPU on as many threads as the other kernels."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads()
    return Model(path, remedy_of(path.parent), options, device)


def encoded(model: Path, inputs: RegionInputs, device: str = "cpu") -> np.ndarray:
    """Encodings f32 [M, C] of all regions."""
    runner = opened(model, device)
    feed = {"inputs": inputs.inputs, "positions": inputs.positions, "mask": inputs.mask}
    starts = range(0, len(inputs.mask), CHUNK)
    encodings = np.concatenate([runner.run({k: v[s : s + CHUNK] for k, v in feed.items()})[0] for s in starts])
    if encodings.ndim != 2 or len(encodings) != len(inputs.mask) or not np.isfinite(encodings).all():
        raise InputError(f"{model} gives {encodings.shape} or values that are not finite; {remedy_of(model.parent)}")
    return encodings


def write(out: Path, arrays: dict[str, Any]) -> None:
    """A .npz that is there whole or not at all."""
    with atomic_path(out) as temporary:
        np.savez(temporary, **arrays)
