"""`scene/2`: the exported scene: PLY for viewers, ragged arrays for us, a label dictionary and a summary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import has_array, open_array, write_array
from chebsplat.formats.cameras import Cameras, read_cameras, write_cameras
from chebsplat.formats.documents import Count, NotRequired, TypedDict, read_document, write_document
from chebsplat.formats.manifest import Manifest, remedy_of
from chebsplat.formats.names import check_names
from chebsplat.formats.ply import REST, write_ply
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.scene/2"
FINITE = (-3.4e38, 3.4e38)
FEATURES = {"features", "raw_features"}
_FLAT = {"means": 3, "log_scales": 3, "quats": 4, "sh0": 3}


class Summary(TypedDict):
    bytes: dict[str, Count]
    max_degree: Count
    n: Count
    left_out: NotRequired[dict[str, str]]


@dataclass
class Scene:
    """N Gaussians sorted by SH degree, stably; raw float32 parameters as in `gaussians/1`.

    parameters: `means`, `log_scales`, `quats`, `logit_opacities`, `sh0` [N,1,3], `shN` [N,15,3] (zero above a
                Gaussian's degree), `degrees` u8 [N] ascending; where there are semantics `features` [N,C], refined or
                fused; where the scene has an encoder, `raw_features` [N,C] that encoder and gate see.
    cameras:    of the views it can be evaluated on.
    order:      i64 [N], row of each Gaussian in the checkpoint, on which the regions depend.
    labels:     i32 [N] class index, -1 none; None without semantics. label_names, label_embeddings f32 [L, C].
    summary:    counts, bytes, and what was left out and why.
    """

    parameters: dict[str, np.ndarray]
    cameras: Cameras
    order: np.ndarray
    labels: np.ndarray | None = None
    label_names: list[str] | None = None
    label_embeddings: np.ndarray | None = None
    summary: dict[str, Any] = field(default_factory=dict)


def write_scene(out: Path, scene: Scene, split_by_degree: bool = True) -> dict[str, int]:
    """Fill the directory that `artifact.publish` yields; returns bytes by part.

    Choices: `scene.ply` is trimmed to the highest degree in use; `scene_d<k>.ply` hold each degree apart, each valid
    on its own; `ragged/` holds SH by bands, so a Gaussian pays only for the bands it keeps. Features are 16-bit fixed
    point: as small as halves, 20 times as exact. Degrees are stored in the checkpoint's order, which they then tell.
    """
    p, degrees = scene.parameters, scene.parameters["degrees"]
    unsorted = np.empty_like(degrees)
    unsorted[scene.order] = degrees
    if not np.array_equal(np.argsort(unsorted, kind="stable"), scene.order):
        raise ValueError("Gaussians are not sorted by degree, stably")
    top = int(degrees.max(initial=0))
    write_ply(out / "scene.ply", p, top, scene.labels, scene.label_names)
    if split_by_degree and len(np.unique(degrees)) > 1:
        for degree in np.unique(degrees):
            chosen = degrees == degree
            part = {name: values[chosen] for name, values in p.items()}
            labels = None if scene.labels is None else scene.labels[chosen]
            write_ply(out / f"scene_d{degree}.ply", part, int(degree), labels, scene.label_names)
    for name, width in _FLAT.items():
        _write_flat(out / "ragged" / name, p[name].reshape(-1, width))
    _write_flat(out / "ragged/logit_opacities", p["logit_opacities"][:, None])
    for band in range(1, top + 1):
        rows = p["shN"][degrees >= band, REST[band - 1] : REST[band]]
        _write_flat(out / f"ragged/sh{band}", rows.reshape(len(rows), -1))
    for name in FEATURES & set(p):
        step = float(np.abs(p[name]).max(initial=0)) / 32767 or 1.0
        _write_flat(out / "semantic" / name, np.round(p[name] / step).astype(np.int16), step)
    write_tensors(out / "degrees.safetensors", {"degrees": unsorted.astype(np.uint8)})
    write_cameras(out, scene.cameras)
    if scene.labels is not None and scene.label_embeddings is not None:
        labelled = {"labels": scene.labels.astype(np.int32), "embeddings": scene.label_embeddings.astype(np.float32)}
        write_tensors(out / "labels.safetensors", labelled)
    write_document(out / "labels.json", dict(enumerate(scene.label_names or [])))
    sizes = {
        "unpruned_ply": 62 * 4 * len(degrees),
        "ply": (out / "scene.ply").stat().st_size,
        "split": sum(f.stat().st_size for f in out.glob("scene_d*.ply")),
        **{
            part: sum(f.stat().st_size for f in (out / part).rglob("*") if f.is_file())
            for part in ("ragged", "semantic")
        },
    }
    write_document(out / "summary.json", scene.summary | {"bytes": sizes, "max_degree": top, "n": len(degrees)})
    return sizes


def read_scene(path: Path) -> Scene:
    """The exported scene at `path`, all in memory. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    unsorted = read_tensors(path, manifest, "degrees.safetensors", {"degrees": ("uint8", "n")})["degrees"]
    if len(unsorted) == 0 or unsorted.max() > 3:
        raise InputError(f"{path / 'degrees.safetensors'} holds a degree beyond 3, or none; {remedy_of(path)}")
    order = np.argsort(unsorted, kind="stable")
    n, degrees = len(order), unsorted[order]

    def flat(name: str, rows: int, width: int) -> np.ndarray:
        return open_array(path, manifest, f"ragged/{name}", (rows, width), "float32", FINITE)[:]

    parameters = {name: flat(name, n, width) for name, width in _FLAT.items()}
    parameters["sh0"] = parameters["sh0"][:, None]
    parameters["logit_opacities"] = flat("logit_opacities", n, 1)[:, 0]
    parameters["shN"] = np.zeros((n, 15, 3), np.float32)
    for band in range(1, int(degrees.max(initial=0)) + 1):
        kept = degrees >= band
        width = REST[band] - REST[band - 1]
        rows = flat(f"sh{band}", int(kept.sum()), 3 * width).reshape(-1, width, 3)
        parameters["shN"][kept, REST[band - 1] : REST[band]] = rows
    parameters["degrees"] = degrees
    cameras = read_cameras(path, manifest)
    summary = read_document(path, manifest, "summary.json", Summary)
    for name in FEATURES:
        if has_array(manifest, f"semantic/{name}"):
            array = open_array(path, manifest, f"semantic/{name}", (n, None), "int16")
            parameters[name] = array[:] * np.float32(array.scale_factor)
    if "features" not in parameters:
        return Scene(parameters, cameras, order, summary=summary)
    names = read_label_names(path, manifest)
    specs = {"labels": ("int32", n), "embeddings": ("float32", len(names), parameters["features"].shape[1])}
    tensors = read_tensors(path, manifest, "labels.safetensors", specs)
    labels = tensors["labels"]
    if not -1 <= labels.min() <= labels.max() < len(names):
        raise InputError(
            f"{path / 'labels.safetensors'}: labels {labels.min()} to {labels.max()} of {len(names)}; "
            + remedy_of(path)
        )
    return Scene(parameters, cameras, order, labels, names, tensors["embeddings"], summary)


def read_label_names(path: Path, manifest: Manifest) -> list[str]:
    """The label dictionary alone, in order of ids. Raises InputError naming file and remedy."""
    names_by_id = read_document(path, manifest, "labels.json", dict[str, str])
    names, file = list(names_by_id.values()), path / "labels.json"
    if list(names_by_id) != [str(k) for k in range(len(names))]:
        raise InputError(f"{file}: the ids are not 0, 1, ... in order; {remedy_of(path)}")
    check_names(names, "labels", file, remedy_of(path))
    return names


def _write_flat(path: Path, rows: np.ndarray, scale_factor: float | None = None) -> None:
    chunk = (max(min(len(rows), 65_536), 1), max(rows.shape[1], 1))
    write_array(path, np.ascontiguousarray(rows), ("gaussian", "value"), chunks=chunk, scale_factor=scale_factor)
