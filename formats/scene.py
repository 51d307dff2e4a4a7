"""`scene/1`: the exported scene: PLY for viewers, ragged arrays for us, a label dictionary and a summary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, has_array, open_array, write_array
from chebsplat.formats.cameras import Cameras, read_cameras, write_cameras
from chebsplat.formats.documents import read_document, write_document
from chebsplat.formats.ply import REST, write_ply
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.scene/1"
_FLAT = {"means": 3, "log_scales": 3, "quats": 4, "sh0": 3}


@dataclass
class Scene:
    """N Gaussians sorted by SH degree, raw float32 parameters as in `gaussians/1`.

    parameters: `means`, `log_scales`, `quats`, `logit_opacities`, `sh0` [N,1,3], `shN` [N,15,3] (zero above a
                Gaussian's degree), `degrees` u8 [N] ascending, and `features` [N,C] where there are semantics.
    cameras:    of the views it can be evaluated on.
    labels:     i32 [N] class index, -1 none; None without semantics. label_names, label_embeddings f32 [L, C].
    summary:    counts, bytes, and what was left out and why.
    """

    parameters: dict[str, np.ndarray]
    cameras: Cameras
    labels: np.ndarray | None = None
    label_names: list[str] | None = None
    label_embeddings: np.ndarray | None = None
    summary: dict[str, Any] = field(default_factory=dict)


def write_scene(out: Path, scene: Scene, split_by_degree: bool = True) -> dict[str, int]:
    """Fill the directory that `artifact.publish` yields; returns bytes by part.

    Choices: `scene.ply` is trimmed to the highest degree in use; `scene_d<k>.ply` hold each degree apart, each valid
    on its own; `ragged/` holds SH by bands, so a Gaussian pays only for the bands it keeps.
    """
    p, degrees = scene.parameters, scene.parameters["degrees"]
    if np.any(np.diff(degrees.astype(int)) < 0):
        raise ValueError("Gaussians are not sorted by degree")
    top = int(degrees.max(initial=0))
    write_ply(out / "scene.ply", p, top, scene.labels)
    if split_by_degree and len(np.unique(degrees)) > 1:
        for degree in np.unique(degrees):
            chosen = degrees == degree
            part = {name: values[chosen] for name, values in p.items()}
            labels = None if scene.labels is None else scene.labels[chosen]
            write_ply(out / f"scene_d{degree}.ply", part, int(degree), labels)
    for name, width in _FLAT.items():
        _write_flat(out / "ragged" / name, p[name].reshape(-1, width))
    _write_flat(out / "ragged/logit_opacities", p["logit_opacities"][:, None])
    for band in range(1, top + 1):
        rows = p["shN"][degrees >= band, REST[band - 1] : REST[band]]
        _write_flat(out / f"ragged/sh{band}", rows.reshape(len(rows), -1))
    if "features" in p:
        _write_flat(out / "ragged/features", p["features"].astype(np.float16))
    write_tensors(out / "degrees.safetensors", {"degrees": degrees.astype(np.uint8)})
    write_cameras(out, scene.cameras)
    if scene.labels is not None and scene.label_embeddings is not None:
        labelled = {"labels": scene.labels.astype(np.int32), "embeddings": scene.label_embeddings.astype(np.float32)}
        write_tensors(out / "labels.safetensors", labelled)
    write_document(out / "labels.json", dict(enumerate(scene.label_names or [])))
    sizes = {
        "ply": (out / "scene.ply").stat().st_size,
        "ragged": sum(f.stat().st_size for f in (out / "ragged").rglob("*") if f.is_file()),
    }
    write_document(out / "summary.json", scene.summary | {"bytes": sizes, "max_degree": top, "n": len(degrees)})
    return sizes


def read_scene(path: Path) -> Scene:
    """Raises: InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    degrees = read_tensors(path, manifest, "degrees.safetensors", {"degrees": ("n",)})["degrees"]
    n = len(degrees)

    def flat(name: str, rows: int, width: int | None) -> np.ndarray:
        array: StoredArray = open_array(
            path, manifest, f"ragged/{name}", (rows, width), "float16" if name == "features" else "float32"
        )
        values = array[:].astype(np.float32)
        if not np.isfinite(values).all():
            raise InputError(f"{array.path} holds non-finite values; {artifact.remedy(path)}")
        return values

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
    summary = read_document(path, manifest, "summary.json", ("bytes", "max_degree", "n"))
    if not has_array(manifest, "ragged/features"):
        return Scene(parameters, cameras, summary=summary)
    parameters["features"] = flat("features", n, None)
    names = list(read_document(path, manifest, "labels.json").values())
    shapes = {"labels": (n,), "embeddings": (len(names), parameters["features"].shape[1])}
    found = read_tensors(path, manifest, "labels.safetensors", shapes)
    return Scene(parameters, cameras, found["labels"], names, found["embeddings"], summary)


def _write_flat(path: Path, rows: np.ndarray) -> None:
    chunk = (max(min(len(rows), 65_536), 1), max(rows.shape[1], 1))
    write_array(path, np.ascontiguousarray(rows), ("gaussian", "value"), chunks=chunk)
