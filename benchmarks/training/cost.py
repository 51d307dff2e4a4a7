"""Cost of a training beside plain 3DGS; with --growth, by Gaussians, pixels and views.

The trainings take turns of fifty steps, so that other load on the machine meets all alike; a short
training of each goes before, so that no kernel is left to compile.

Of growth, each case is a process of its own: some steps of the default training, colour and depth
loss, on views of the scene that are enlarged and repeated, from as many points of its depth as
Gaussians are wanted. Exponents are slopes of logarithms between the first and the last case of a
row.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from argparse import SUPPRESS
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.cameras import unproject
from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.points import Points
from chebsplat.pipelines.planning.plan import merged
from chebsplat.pipelines.work.scenes import read_toml
from chebsplat.settings import MOST_STEPS
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.training.assembly import Inputs, assemble, read_inputs
from chebsplat.training.trainer import Trainer

BAR, TURN, REHEARSAL = 1.25, 50, 100
BASE = (20_000, (320, 240), 60)  # Gaussians, pixels, views
GROWTH = {
    "Gaussians": [(n, BASE[1], BASE[2]) for n in (20_000, 100_000, 400_000, 1_000_000)],
    "pixels": [
        (BASE[0], size, BASE[2]) for size in ((320, 240), (640, 480), (1280, 960), (1920, 1080))
    ],
    "views": [(*BASE[:2], n) for n in (60, 300, 1000)],
    "all": [(400_000, (1920, 1080), 1000)],
}
# steps of a case before those that are timed, and these; gigabytes
WARM, TIMED, BOUND = 10, 30, 6.0


def job_of(config: Config, inputs: dict[str, Path], device: str = "cpu") -> Job:
    """A job of a training that publishes nothing."""
    nowhere = Path(os.devnull)
    return Job(inputs, config, nowhere, nowhere, device)


def trainer_from(work: Path, config: Config, backend: str = "auto", device: str = "cpu") -> Trainer:
    """The train stage's trainer before its first step, of a scene that has been run up to its
    teacher.

    Args: work: folder of the links `ingest`, `sfm` and, if semantics are trained, `teacher`;
      backend: of the rasterizer; device: `cpu` or `cuda`.
    """
    inputs = {"capture": work / "ingest", "points": work / "sfm"}
    job = job_of(
        config, inputs | ({"features": work / "teacher"} if config.train.semantics else {}), device
    )
    return assemble(job, read_inputs(job), backend)


def begun(work: Path, ablation: str, steps: int) -> Trainer:
    values = read_toml("ablations", ablation) if ablation != "full" else {}
    return trainer_from(work, Config.model_validate(merged(values, {"train": {"steps": steps}})))


def by_turns(work: Path, variants: Sequence[str], n_steps: int) -> dict[str, float]:
    """Milliseconds a step of whole trainings; returns multiples of the first variant's."""
    for name in variants:
        for _ in begun(work, name, REHEARSAL).steps():
            pass
    trainers = {name: begun(work, name, n_steps) for name in variants}
    rounds = {name: trainer.steps() for name, trainer in trainers.items()}
    for n_done in range(0, n_steps, TURN):
        for steps in rounds.values():
            for _ in range(min(TURN, n_steps - n_done)):
                next(steps)
        if (n_done + TURN) % 500 == 0 or n_done + TURN >= n_steps:
            print(f"after {min(n_done + TURN, n_steps)} steps")
            for name, trainer in trainers.items():
                ratio = trainer.seconds / trainers[variants[0]].seconds
                parts = "  ".join(
                    f"{part} {1e3 * s / trainer.step:.1f}"
                    for part, s in trainer.laps.seconds.items()
                )
                print(
                    f"  {name:12s} {1e3 * trainer.seconds / trainer.step:6.1f} ms a step  "
                    f"×{ratio:.2f}  {parts}"
                )
    return {
        name: trainer.seconds / trainers[variants[0]].seconds for name, trainer in trainers.items()
    }


def enlarged(work: Path, size: tuple[int, int], n_views: int, out: Path) -> Path:
    """A capture of a scene's training views, repeated and enlarged to pixels (width, height)."""
    source = Capture.read(work / "ingest")
    assert source.cam_from_world is not None and source.depth is not None
    used = np.resize(np.flatnonzero(~source.is_test), n_views)
    rows = np.arange(size[1]) * source.size[1] // size[1]
    columns = np.arange(size[0]) * source.size[0] // size[0]
    images = np.empty((n_views, size[1], size[0], 3), np.uint8)
    depth = np.empty((n_views, size[1], size[0]), np.float32)
    for k, view in enumerate(used):
        images[k] = source.images[view][rows[:, None], columns]
        depth[k] = source.depth[view][rows[:, None], columns]
    Ks = source.Ks[used] * np.array([[size[0] / source.size[0]], [size[1] / source.size[1]], [1.0]])
    nothing: dict[str, Any] = {
        "labels": None,
        "loss_mask": None,
        "pseudo_labels": None,
        "confidence": None,
    }
    capture = replace(
        source, names=[f"view{k:04d}" for k in range(n_views)], images=images, depth=depth, Ks=Ks,
        cam_from_world=source.cam_from_world[used], is_test=np.zeros(n_views, bool), **nothing,
    )  # fmt: skip
    folder = out / "capture"
    with artifact.publish(
        folder, Manifest(Capture.SCHEMA, artifact.digest({"case": str(out)}), "ingest")
    ) as tmp:
        capture.write(tmp)
    return folder


def measured(capture: Path, n_gaussians: int, device: str = "cpu") -> dict[str, float]:
    """Cost of a training, alone in this process, whose memory on a GPU is that of its tensors."""
    photos, rng = Capture.read(capture), np.random.default_rng(0)
    assert photos.cam_from_world is not None and photos.depth is not None
    views = np.linspace(0, len(photos.names) - 1, 60).astype(int)
    means, colors = [], []
    for view in views:
        pixels = np.stack(
            [rng.integers(0, side, n_gaussians // len(views) + 1) for side in photos.size[::-1]], 1
        )
        means.append(
            unproject(photos.depth[view], photos.Ks[view], photos.cam_from_world[view], pixels)
        )
        colors.append(photos.images[view][pixels[:, 0], pixels[:, 1]])
    places = np.concatenate(means)[:n_gaussians] + rng.normal(0, 1e-4, (n_gaussians, 3))
    shapes, normals = local_shape(places, 16)
    points = Points(
        photos.names,
        photos.Ks,
        photos.cam_from_world,
        places,
        np.concatenate(colors)[:n_gaussians],
        normals,
        shapes,
        np.zeros((0, 2), np.int32),
        {"how": "depth"},
    )
    settings = {
        "steps": 3000,
        "semantics": False,
        "max_gaussians": 2 * n_gaussians,
        "weight_depth": 0.8,
    }
    config = Config.model_validate({"train": settings})
    trainer = assemble(job_of(config, {}, device), Inputs(photos, points))
    trainer.step = int(config.train.steps * 0.1)  # at full resolution, before growth
    steps = trainer.steps()
    for _ in range(WARM):
        next(steps)
    if device == "cuda":
        torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(TIMED):
        next(steps)
    if device == "cuda":
        torch.cuda.synchronize()
    seconds = (time.perf_counter() - began) / TIMED
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else shared.peak_memory()
    return {"step_ms": 1e3 * seconds, "peak_gb": peak / 2**30}


def growth(work: Path, names: Sequence[str], out: Path) -> int:
    """A row for each case, and the exponents; 1 if a thousand views take more than BOUND."""
    rows: list[dict[str, Any]] = []
    for name in names:
        for n_gaussians, size, n_views in GROWTH[name]:
            with tempfile.TemporaryDirectory(prefix="growth-") as folder:
                capture = enlarged(work, size, n_views, Path(folder))
                stored = sum(file.stat().st_size for file in capture.rglob("*") if file.is_file())
                command = [sys.executable, "-m", "benchmarks", "cost", "--work", str(work)]
                command += ["--case", str(capture), str(n_gaussians)]
                process = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            row = {
                "row": name,
                "gaussians": n_gaussians,
                "width": size[0],
                "height": size[1],
                "views": n_views,
            }
            rows.append(row | json.loads(process.stdout) | {"disk_gb": stored / 2**30})
            print(
                "{gaussians:>9,} Gaussians  {width:>4}×{height:<4}  {views:>4} views  "
                "{step_ms:7.1f} ms a step  {peak_gb:5.2f} GB  {disk_gb:6.3f} GB on disk".format(
                    **rows[-1]
                ),
                flush=True,
            )
        first, last = ([row for row in rows if row["row"] == name][k] for k in (0, -1))
        if first is not last:
            sizes = [
                {
                    "Gaussians": row["gaussians"],
                    "views": row["views"],
                    "pixels": row["width"] * row["height"],
                }[name]
                for row in (first, last)
            ]
            grown = sizes[1] / sizes[0]
            slopes = (
                math.log(last[key] / first[key]) / math.log(grown)
                for key in ("step_ms", "peak_gb", "disk_gb")
            )
            print("with {}: step ^{:.2f}, memory ^{:.2f}, disk ^{:.2f}".format(name, *slopes))
    shared.write_csv(out / "growth.csv", rows)
    largest = [row["peak_gb"] for row in rows if row["views"] == 1000]
    bars: list[shared.Bar] = [("GB, 1000 views of 1920×1080", of, "<=", BOUND) for of in largest]
    return int(not all(shared.judged(bars)))


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("cost", __doc__, work=True)
    parser.add_argument("--steps", type=int, default=MOST_STEPS)
    parser.add_argument("--ablations", nargs="*", default=[])
    parser.add_argument("--growth", choices=list(GROWTH), nargs="+", help="instead: by size")
    parser.add_argument(
        "--case", nargs=2, help=SUPPRESS
    )  # a capture and a number of Gaussians: in a process of its own
    options = parser.parse_args(arguments)
    if options.case:
        print(json.dumps(measured(Path(options.case[0]), int(options.case[1]))))
        return 0
    print(shared.machine())
    if options.growth:
        return growth(options.work, options.growth, options.out)
    ratio = by_turns(options.work, ("plain", "full", *options.ablations), options.steps)["full"]
    return int(not all(shared.judged([("full over plain", ratio, "<=", BAR)])))
