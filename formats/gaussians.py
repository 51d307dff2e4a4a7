"""`gaussians/1`: the checkpoint of a trained scene, all raw parameters, and the trace of its training."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.cameras import POSES, Cameras, check_cameras, read_cameras, write_cameras
from chebsplat.formats.documents import Count, NotRequired, TypedDict, conform, read_document, write_document
from chebsplat.formats.files import read_text
from chebsplat.formats.manifest import Manifest, remedy_of
from chebsplat.formats.ply import REST
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.gaussians/1"
SPECS: dict[str, Spec] = {
    "means": ("float32", "n", 3),
    "log_scales": ("float32", "n", 3),
    "quats": ("float32", "n", 4),
    "logit_opacities": ("float32", "n"),
    "sh0": ("float32", "n", 1, 3),
    "shN": ("float32", "n", "k", 3),
    "degrees": ("uint8", "n"),
}
SEMANTIC: dict[str, Spec] = {"features": ("float32", "n", "c"), "fused": ("float32", "n", "c")}


class EncoderSettings(TypedDict):
    n_inputs: Annotated[int, Ge(0), Le(10_000)]
    n_channels: Annotated[int, Ge(1), Le(1024)]
    width: Annotated[int, Ge(1), Le(1024)]
    n_layers: Annotated[int, Ge(0), Le(64)]
    n_heads: Annotated[int, Ge(1), Le(64)]
    n_positions: NotRequired[Literal[3, 6]]  # 3 before there was a choice


class Notes(TypedDict):
    left_out: NotRequired[dict[str, str]]
    n_initial: NotRequired[Count]
    encoder: NotRequired[EncoderSettings]


class Row(TypedDict):
    """What a trace says in every row; the losses that there are besides."""

    step: float
    seconds: float
    psnr: float


@dataclass
class Gaussians:
    """Raw parameters in float32; the name of each carries its transform.

    parameters: `means` [N,3] scene units, `log_scales` [N,3], `quats` [N,4] wxyz, `logit_opacities` [N],
                `sh0` [N,1,3], `shN` [N,15,3], `degrees` u8 [N] highest SH band kept, and, where the scene has a
                semantic branch, `features` [N,C] and `fused` [N,C].
    cameras:    of the views it was trained and may be evaluated on.
    modules:    weights of the encoder, gate and masks by dotted name; empty where they were left out.
    optimizer:  moments and step counts, so that a training can be resumed.
    trace:      one row a report interval: error against run time.
    notes:      encoder sizes, label names, and what the scene left out and why.
    given_poses: f64 [V, 4, 4] cam_from_world that the cameras had before the training refined them; None: it did not.
    """

    parameters: dict[str, np.ndarray]
    cameras: Cameras
    modules: dict[str, np.ndarray] = field(default_factory=dict)
    optimizer: dict[str, np.ndarray] = field(default_factory=dict)
    trace: list[dict[str, float]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    given_poses: np.ndarray | None = None

    def encoder(self) -> tuple[dict[str, int], dict[str, np.ndarray]]:
        """Settings and weights of the local encoder. Raises InputError if the scene was trained without one."""
        if "encoder" not in self.notes:
            raise InputError("the scene was trained without an encoder; train it with train.encoder = transformer")
        prefix = "shape.encoder."
        weights = {k.removeprefix(prefix): v for k, v in self.modules.items() if k.startswith(prefix)}
        return self.notes["encoder"], weights


def write_gaussians(out: Path, gaussians: Gaussians) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite parameter.

    Choices: SH bands that no Gaussian keeps are left out of the file; reading gives them back as zeros.
    """
    degrees, shN = gaussians.parameters["degrees"], gaussians.parameters["shN"]
    kept = shN[:, : (int(degrees.max(initial=0)) + 1) ** 2 - 1]
    write_tensors(out / "parameters.safetensors", gaussians.parameters | {"shN": kept})
    write_cameras(out, gaussians.cameras)
    write_document(out / "notes.json", gaussians.notes)
    given = {} if gaussians.given_poses is None else {"cam_from_world": gaussians.given_poses}
    for name, arrays in (("modules", gaussians.modules), ("optimizer", gaussians.optimizer), ("given", given)):
        if arrays:
            write_tensors(out / f"{name}.safetensors", arrays)
    with (out / "trace.csv").open("w", newline="") as handle:
        columns = list(gaussians.trace[0]) if gaussians.trace else ["step", "seconds"]
        writer = csv.DictWriter(handle, columns)
        writer.writeheader()
        writer.writerows(gaussians.trace)


def read_gaussians(path: Path) -> Gaussians:
    """The checkpoint at `path`; SH bands that it leaves out are zeros.

    Raises: InputError naming the damaged file and the remedy.
    """
    manifest = artifact.read_manifest(path, SCHEMA)
    file, remedy = path / "parameters.safetensors", remedy_of(path)
    parameters = read_tensors(path, manifest, file.name, SPECS)
    if semantic := {name: spec for name, spec in SEMANTIC.items() if name in parameters}:
        parameters = read_tensors(path, manifest, file.name, SPECS | semantic)
    n, shN = len(parameters["means"]), parameters["shN"]
    if parameters["degrees"].max(initial=0) > 3 or shN.shape[1] not in REST.values():
        raise InputError(f"{file}: SH {shN.shape} or a degree beyond 3 make no scene; {remedy}")
    parameters["shN"] = np.concatenate([shN, np.zeros((n, 15 - shN.shape[1], 3), np.float32)], 1)
    optional = {
        name: read_tensors(path, manifest, f"{name}.safetensors") if f"{name}.safetensors" in manifest.files else {}
        for name in ("modules", "optimizer")
    }
    cameras, given = read_cameras(path, manifest), None
    if "given.safetensors" in manifest.files:
        specs = {"cam_from_world": POSES["cam_from_world"]}
        given = read_tensors(path, manifest, "given.safetensors", specs)["cam_from_world"]
        check_cameras(cameras.names, cameras.Ks, given, path / "given.safetensors", remedy)
    return Gaussians(
        parameters,
        cameras,
        optional["modules"],
        optional["optimizer"],
        read_trace(path, manifest),
        read_document(path, manifest, "notes.json", Notes),
        given,
    )


def read_trace(path: Path, manifest: Manifest) -> list[dict[str, float]]:
    """The trace alone, without the parameters. Raises InputError naming file and remedy."""
    file, remedy = artifact.checked(path, manifest, "trace.csv"), remedy_of(path)
    try:
        table = csv.DictReader(read_text(file, remedy).splitlines())
        trace = [{name: float(value) for name, value in row.items()} for row in table]
        if not {"step", "seconds"} <= set(table.fieldnames or ()):
            raise ValueError("it has no columns step and seconds")
    except (csv.Error, ValueError, TypeError) as error:
        raise InputError(f"{file} is no table of numbers ({error}); {remedy}") from None
    if not all(map(math.isfinite, (value for row in trace for value in row.values()))):
        raise InputError(f"{file} holds values that are not finite; {remedy}")
    return conform(trace, list[Row], file, remedy)
