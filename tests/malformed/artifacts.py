"""Small artifacts of every schema that fit together, made without a training; damaged copies with digests made anew."""

from __future__ import annotations

import atexit
import functools
import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

N, V, C, SIZE = 40, 3, 5, (24, 16)  # Gaussians, views, channels, width and height
KEY = "0123456789abcdef"
VIEWS, LABELS = [f"view_{k}" for k in range(V)], ["wall", "floor", "sofa"]
NOTES = {"left_out": {}, "n_initial": N}
DESCRIBED = {"n_angles": 2, "max_degree": 3, "anisotropy": 10.0, "bandwidth": 0.7, "spectrum": "full", "n_eigs": 16}


@functools.cache
def artifacts() -> Path:
    """A folder with an artifact of each schema, by the name of its stage; made once a process."""
    root = Path(tempfile.mkdtemp(prefix="malformed-artifacts-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    for stage, (schema, write) in WRITERS.items():
        _publish(root / stage, schema, stage, write)
    return root


def copied(stage: str, folder: Path) -> Path:
    """A copy below `folder` that may be damaged."""
    return Path(shutil.copytree(artifacts() / stage, folder / stage))


def resealed(path: Path) -> Path:
    """Make a manifest fit its files again, however these were changed; files that are new are listed, too."""
    manifest = json.loads((path / "artifact.json").read_text())
    members = sorted(file for file in path.rglob("*") if file.is_file() and file.name != "artifact.json")
    manifest["files"] = {
        file.relative_to(path).as_posix(): {
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "bytes": file.stat().st_size,
        }
        for file in members
    }
    (path / "artifact.json").write_text(json.dumps(manifest))
    return path


def set_value(file: Path, keys: tuple[Any, ...], value: Any) -> None:
    """Put a value into a JSON document; no keys: in its place."""
    document = json.loads(file.read_text())
    if not keys:
        document = value
    else:
        inner = document
        for key in keys[:-1]:
            inner = inner[key]
        if value is ...:
            del inner[keys[-1]]
        else:
            inner[keys[-1]] = value
    file.write_text(json.dumps(document))


def set_tensor(file: Path, name: str, change: Callable[[np.ndarray], np.ndarray | None]) -> None:
    """Change one array of a safetensors file; None takes it away."""
    from safetensors.numpy import load_file, save_file

    arrays = load_file(file)
    found = change(arrays.pop(name).copy())
    save_file(arrays | ({} if found is None else {name: np.ascontiguousarray(found)}), file)


def _publish(path: Path, schema: str, stage: str, write: Callable[[Path], Any]) -> None:
    from chebsplat.formats import artifact
    from chebsplat.formats.manifest import Manifest
    from chebsplat.stages.config import Config

    config = Config.model_validate({"describe": DESCRIBED | {"n_regions": 4, "region_size": 8}, "sfm": {}})
    manifest = Manifest(schema, KEY, stage, config=config.sections(("describe", "train")))
    manifest.facts = {
        "teacher": {"kind": "labels", "n_labels": len(LABELS), "convention": {"confusion": 0.1}},
        "agree": {"agreement": 0.375, "n_points": N},
        "train": {"milliseconds": {"render": 1.0}},
        "export": {"by_degree": [N, 0, 0, 0]},
    }.get(stage, {})
    with artifact.publish(path, manifest) as tmp:
        write(tmp)


def _poses() -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]])
    poses = np.tile(np.eye(4), (V, 1, 1))
    poses[:, 0, 3] = np.arange(V) * 0.1
    return np.tile(K, (V, 1, 1)), poses


def _parameters() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"means": (N, 3), "log_scales": (N, 3), "quats": (N, 4), "logit_opacities": (N,), "sh0": (N, 1, 3)}
    shapes |= {"features": (N, C), "fused": (N, C)}
    p = {name: rng.normal(0, 0.5, shape).astype(np.float32) for name, shape in shapes.items()}
    p["means"][:, 2] += 3
    return p | {"shN": np.zeros((N, 15, 3), np.float32), "degrees": np.zeros(N, np.uint8)}


def _cameras() -> Any:
    from chebsplat.formats.cameras import Cameras

    return Cameras(VIEWS, *_poses(), *SIZE)


def _capture(out: Path) -> None:
    from chebsplat.formats.capture import Capture, write_capture

    rng, (width, height) = np.random.default_rng(1), SIZE
    Ks, poses = _poses()
    images = rng.integers(0, 255, (V, height, width, 3), dtype=np.uint8)
    depth = np.full((V, height, width), 3, np.float32)
    labels = rng.integers(-1, len(LABELS), (V, height, width)).astype(np.int16)
    is_test = np.arange(V) == 0
    source, protocol = {"name": "toy", "kind": "generated"}, {"name": "labels", "split": "every third"}
    write_capture(out, Capture(VIEWS, images, Ks, poses, is_test, depth, labels, None, LABELS, source, protocol))


def _points(out: Path) -> None:
    from chebsplat.formats.points import Points, write_points

    normals = np.tile(np.array([0, 0, 1], np.float32), (N, 1))
    shape = np.tile(np.eye(3, dtype=np.float32), (N, 1, 1))
    means = _parameters()["means"].astype(np.float64)
    tracks = np.zeros((0, 2), np.int32)
    write_points(out, Points(VIEWS, *_poses(), means, np.zeros((N, 3), np.uint8), normals, shape, tracks, {}))


def _embeddings() -> np.ndarray:
    return np.eye(len(LABELS), C, dtype=np.float32)


def _features(out: Path) -> None:
    from chebsplat.formats.features import Features, write_features

    maps = np.random.default_rng(2).normal(0, 0.3, (V, 4, 6, C)).astype(np.float16)
    pseudo, sure = np.zeros((V, 4, 6), np.int16), np.ones((V, 4, 6), np.float16)
    convention = {"kind": "labels", "normalized": True}
    write_features(out, Features(VIEWS, maps, LABELS, _embeddings(), pseudo, sure, convention))


def _descriptors(out: Path) -> None:
    from chebsplat.formats.descriptors import Descriptors, write_descriptors

    members = np.arange(4 * 8).reshape(4, 8)
    settings = DESCRIBED | {"n_regions": 4, "region_size": 8, "seed": 0, "radius": 1.0, "share": 0.5}
    write_descriptors(out, Descriptors(members[:, 0], members, np.zeros((4, 8, 2, 2), np.float32), settings))


def _gaussians(out: Path) -> None:
    from chebsplat.formats.gaussians import Gaussians, write_gaussians

    encoder = {"n_inputs": 9, "n_channels": C, "width": 8, "n_layers": 1, "n_heads": 2}
    trace = [{"step": 10.0, "seconds": 1.0, "n": float(N), "psnr": 20.0}]
    notes = NOTES | {"encoder": encoder, "label_names": LABELS}
    modules = {"shape.gate.weight": np.ones((2, 2), np.float32)}
    write_gaussians(out, Gaussians(_parameters(), _cameras(), modules, {}, trace, notes))


def _agreement(out: Path) -> None:
    from chebsplat.formats.agreement import ViewAgreement, write_agreement

    labels = {"wall": {"share": 0.75, "agreement": 0.5}, "floor": {"share": 0.25, "agreement": 0.25}}
    write_agreement(out, ViewAgreement(0.375, N, V - 1, labels))


def _lifted(out: Path) -> None:
    from chebsplat.formats.lifted import Lifted, write_lifted

    ones, views = np.ones(N, np.float32), np.full((2, N), 2, np.int32)
    features = np.random.default_rng(3).normal(size=(N, C)).astype(np.float32)
    notes = {"views": VIEWS[1:], "n_observations": 4 * N}
    write_lifted(
        out, Lifted(features, ones, views.sum(0, dtype=np.int32), ones, np.stack([features] * 2), views, notes)
    )


def _refined(out: Path) -> None:
    from chebsplat.formats.refined import Refined, write_refined

    features = np.random.default_rng(4).normal(size=(N, C)).astype(np.float32)
    notes = {"start": "trained", "smooth": True, "strength": 0.0, "curve": {"off": {"0": 0.8}, "on": {"0": 0.9}}}
    write_refined(out, Refined(features, np.ones(N, np.float32), notes))


def _knowledge(out: Path) -> None:
    from chebsplat.formats.knowledge import Knowledge, write_knowledge
    from chebsplat.settings import DescribeSection

    encoder = {"n_channels": C, "n_descriptors": 0, "n_components": 0, "width": 4, "hidden": 4, "n_scales": 4}
    weights = {"embed.0.weight": np.zeros((64, 6), np.float32)}
    describe, card = DescribeSection().model_dump(mode="json"), {"n_rooms": 1}
    matrix = np.eye(C + 2, C, dtype=np.float32)
    words = ["wall"], np.ones((1, C), np.float16)
    write_knowledge(out, Knowledge("tiny", "0" * 64, encoder, weights, matrix, describe, *words, card))


def _scene(out: Path) -> None:
    from chebsplat.formats.scene import Scene, write_scene

    p = _parameters()
    p["raw_features"] = p.pop("fused")
    labels = np.arange(N, dtype=np.int32) % len(LABELS)
    write_scene(out, Scene(p, _cameras(), np.arange(N), labels, LABELS, _embeddings(), NOTES))


def _encoder(out: Path) -> None:
    from chebsplat.formats.encoder import DYNAMIC, FLOAT, FUSED, write_encoder

    for name in (FLOAT, DYNAMIC, FUSED):
        (out / name).write_bytes(b"no model")
    describe = DESCRIBED | {"n_regions": 4, "region_size": 8, "seed": 0}
    settings = {"describe": describe, "n_covers": 2, "described": True, "context": True, "n_inputs": 9, "n_channels": C}
    write_encoder(out, {"encoder": {}, "fusion": {}, "settings": settings}, {FLOAT: [], DYNAMIC: [], FUSED: []})


def _basis(out: Path) -> None:
    from chebsplat.formats.basis import Basis, write_basis

    report = {
        "rank_before": 0,
        "rank_after": 2,
        "added": 2,
        "rho": 1.0,
        "rho_after": 0.1,
        "energy": 0.99,
        "rho_printed": 2.0,
    }
    entry = {"scene": "toy", "gaussians": KEY, "spread": 1.0, "maps": {"blocks.0.query": report}}
    bases = {"blocks.0.query": np.eye(8, 2, dtype=np.float32)}
    write_basis(out, Basis(bases, {"blocks.0.query": np.eye(8, dtype=np.float32)}, [entry]))


def _evaluation(out: Path) -> None:
    from chebsplat.formats.evaluation import Evaluation, write_evaluation

    (width, height), blank = SIZE, np.zeros((1, SIZE[1], SIZE[0], 3), np.uint8)
    sizes = dict.fromkeys(("unpruned_ply", "ply", "split", "ragged", "semantic"), 100)
    whole = {"miou": 0.5, "macc": 0.5, "oa": 0.5, "boundary_miou": None, "iou": {"wall": 0.5}}
    figures = {"names": VIEWS[:1], "image": {"psnr": 20.0, "ssim": 0.5, "per_view": {"psnr": [20.0], "ssim": [0.5]}}}
    figures |= {
        "source": {"name": "toy", "kind": "generated", "notes": []},
        "protocol": {"name": "labels", "split": "every third"},
    }
    figures |= {"n_gaussians": N, "bytes": sizes, "frames_per_second": {}, "milliseconds": {}, "lpips": None}
    figures |= {"left_out": {}, "segmentation": {"classes": LABELS, "scene": whole, "teacher": whole}}
    labels = np.zeros((1, height, width), np.int16)
    pictures = {"truth": blank, "renders": blank, "labels": labels, "predicted": labels, "teacher": labels}
    write_evaluation(out, Evaluation(figures, pictures))


WRITERS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "ingest": ("chebsplat.capture/1", _capture),
    "sfm": ("chebsplat.points/1", _points),
    "teacher": ("chebsplat.features/1", _features),
    "agree": ("chebsplat.agreement/1", _agreement),
    "describe": ("chebsplat.descriptors/1", _descriptors),
    "teach": ("chebsplat.knowledge/1", _knowledge),
    "train": ("chebsplat.gaussians/1", _gaussians),
    "lift": ("chebsplat.lifted/1", _lifted),
    "refine": ("chebsplat.refined/1", _refined),
    "export": ("chebsplat.scene/2", _scene),
    "onnx": ("chebsplat.encoder/2", _encoder),
    "cks": ("chebsplat.basis/3", _basis),
    "evaluate": ("chebsplat.evaluation/1", _evaluation),
}
