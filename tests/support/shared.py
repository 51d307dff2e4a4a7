"""What tests share: the toy scene's settings, how stages feed one another, third-party data."""

import hashlib
import json
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KEY = "0" * 16  # of artifacts whose identity is no matter
DATA = Path(os.environ.get("CHEBSPLAT_TEST_DATA", ROOT / "../shared/data"))

TOY = {
    "scene": {"name": "toy"},
    "source": {"kind": "generated", "preset": "toy", "seed": 1},
    "sfm": {"max_points": 300},
    "teacher": {"kind": "labels"},
    "describe": {"n_regions": 24, "region_size": 8},
    "teach": {"n_rooms": 1, "n_held_out": 1, "n_views": 6, "n_points": 200, "steps": 3},
    "train": {
        "steps": 24,
        "max_gaussians": 500,
        "n_densify": 2,
        "report_every": 8,
        "refresh_every": 8,
    },
}
INPUTS = {
    "ingest": {},
    "sfm": {"capture": "ingest"},
    "channels": {},
    "teacher": {"capture": "ingest"},
    "agree": {"capture": "ingest", "points": "sfm", "features": "teacher"},
    "teach": {"channels": "channels"},
    "describe": {"capture": "ingest", "points": "sfm"},
    "encode": {"descriptors": "describe", "start": "teach"},
    "learn": {
        "capture": "ingest",
        "points": "sfm",
        "descriptors": "describe",
        "encoding": "encode",
        "features": "teacher",
        "start": "teach",
    },
    "recall": {"start": "teach", "lesson": "learn"},
    "onnx": {"knowledge": "recall", "descriptors": "describe"},
    "train": {"capture": "ingest", "points": "sfm", "features": "teacher"},
    "export": {"gaussians": "train", "features": "teacher"},
    "lift": {"capture": "ingest", "gaussians": "train", "features": "teacher"},
    "refine": {
        "capture": "ingest",
        "gaussians": "train",
        "lifted": "lift",
        "features": "teacher",
        "descriptors": "describe",
        "encoding": "encode",
        "knowledge": "recall",
    },
    "evaluate": {"capture": "ingest", "scene": "export", "features": "teacher"},
    "report": {
        "evaluation": "evaluate",
        "gaussians": "train",
        "scene": "export",
        "features": "teacher",
        "agreement": "agree",
    },
}


def key_of(name):
    """A key that a test can tell from another."""
    return hashlib.sha256(str(name).encode()).hexdigest()[:16]


def remember(work, code_memo):
    """Spare a planner the reading of code that it has read before; returns the work folder."""
    (work / ".cache").mkdir(parents=True, exist_ok=True)
    (work / ".cache/code.json").write_text(code_memo)
    return work


def gaussian_parameters(n=6, seed=0):
    """Random raw parameters, sorted by degree, zero above it."""
    import numpy as np

    from chebsplat.formats.ply import REST

    rng = np.random.default_rng(seed)
    degrees = np.sort(rng.integers(0, 4, n)).astype(np.uint8)
    shN = rng.normal(size=(n, 15, 3)).astype(np.float32)
    for row, degree in enumerate(degrees):
        shN[row, REST[int(degree)] :] = 0
    shapes = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "logit_opacities": (n,),
        "sh0": (n, 1, 3),
    }
    return {k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()} | {
        "shN": shN,
        "degrees": degrees,
    }


def published(path, record, **facts):
    """Publish a record as an artifact of its kind; returns its path."""
    from chebsplat.formats import artifact
    from chebsplat.formats.manifest import Manifest

    with artifact.publish(path, Manifest(record.SCHEMA, KEY, "test", **facts)) as tmp:
        record.write(tmp)
    return path


def data(name):
    """A folder of third-party data, or a skip that names it."""
    if not (DATA / name).is_dir():
        pytest.skip(f"{name}: no such folder (CHEBSPLAT_TEST_DATA)")
    return DATA / name


def run_stage(stage, out, inputs=None, config=None):
    """Run a stage's own command; returns its exit code."""
    from importlib import import_module

    from chebsplat.stages.runtime.command import command

    out.parent.mkdir(parents=True, exist_ok=True)
    file = out.parent / f"{out.name}.json"
    file.write_text(json.dumps(TOY if config is None else config))
    arguments = ["--config", str(file), "--out", str(out), "--device", "cpu"]
    for role, path in (inputs or {}).items():
        arguments += [f"--in-{role}", str(path)]
    with pytest.raises(SystemExit) as stop:
        command(stage, import_module(f"chebsplat.stages.{stage}").run)(arguments, prog_name=stage)
    return stop.value.code


def finish(plan):
    """Pretend that every step of a plan has run."""
    from chebsplat.formats import artifact
    from chebsplat.formats.manifest import Manifest
    from chebsplat.stages.registry import STAGES

    for step in plan.steps:
        inputs = {role: {"key": path.name, "schema": "s/1"} for role, path in step.inputs.items()}
        with artifact.publish(
            step.path, Manifest(STAGES[step.stage].schema, step.key, step.stage, inputs)
        ):
            pass


def photo_folder(folder):
    from PIL import Image

    folder.mkdir(parents=True)
    for k in range(4):
        Image.new("RGB", (32, 24), (60 * k, 0, 0)).save(folder / f"{k}.jpg")
    return f"{folder}/"
