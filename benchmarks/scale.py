"""How a training grows: seconds a step, peak memory and bytes on disk by Gaussians, pixels and views.

Each case is a process of its own: some steps of the default training, colour and depth loss, on views of a scene that
are enlarged and repeated, from as many points of its depth as Gaussians are wanted. Exponents are slopes of logarithms
between the first and the last case of a row.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import chebsplat
from benchmarks import shared

BASE = (20_000, (320, 240), 60)  # Gaussians, pixels, views
GROWTH = {
    "Gaussians": [(n, BASE[1], BASE[2]) for n in (20_000, 100_000, 400_000, 1_000_000)],
    "pixels": [(BASE[0], size, BASE[2]) for size in ((320, 240), (640, 480), (1280, 960), (1920, 1080))],
    "views": [(*BASE[:2], n) for n in (60, 300, 1000)],
    "all": [(400_000, (1920, 1080), 1000)],
}
STEPS, FIRST, BOUND = 40, 10, 6.0  # steps, those of them that are not timed, gigabytes


def enlarged(work: Path, size: tuple[int, int], n_views: int, out: Path) -> tuple[Path, int]:
    """A capture of a scene's training views, repeated and enlarged to pixels (width, height), and its bytes on disk."""
    from chebsplat.formats import artifact
    from chebsplat.formats.capture import SCHEMA, read_capture, write_capture
    from chebsplat.formats.manifest import Manifest

    given = read_capture(work / "ingest")
    assert given.cam_from_world is not None and given.depth is not None
    used = np.resize(np.flatnonzero(~given.is_test), n_views)
    rows = np.arange(size[1]) * given.size[1] // size[1]
    columns = np.arange(size[0]) * given.size[0] // size[0]
    images = np.empty((n_views, size[1], size[0], 3), np.uint8)
    depth = np.empty((n_views, size[1], size[0]), np.float32)
    for k, view in enumerate(used):
        images[k] = given.images[view][rows[:, None], columns]
        depth[k] = given.depth[view][rows[:, None], columns]
    Ks = given.Ks[used] * np.array([[size[0] / given.size[0]], [size[1] / given.size[1]], [1.0]])
    nothing: dict[str, Any] = {"labels": None, "loss_mask": None, "pseudo_labels": None, "confidence": None}
    capture = replace(
        given, names=[f"view{k:04d}" for k in range(n_views)], images=images, depth=depth, Ks=Ks,
        cam_from_world=given.cam_from_world[used], is_test=np.zeros(n_views, bool), **nothing,
    )  # fmt: skip
    folder = out / "capture"
    with artifact.publish(folder, Manifest(SCHEMA, artifact.digest({"case": str(out)}), "ingest")) as tmp:
        write_capture(tmp, capture)
    return folder, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def measured(capture: Path, n_gaussians: int, steps: int) -> dict[str, float]:
    """What a training of this process takes; nothing else is to be in its memory."""
    from chebsplat.cameras import extent, unproject
    from chebsplat.formats.capture import read_capture
    from chebsplat.formats.points import Points
    from chebsplat.splats.gaussians import local_shape
    from chebsplat.stages.config import Config
    from chebsplat.stages.train_inputs import model_of, training_views
    from chebsplat.training.trainer import Trainer

    held, rng = read_capture(capture), np.random.default_rng(0)
    assert held.cam_from_world is not None and held.depth is not None
    views = np.linspace(0, len(held.names) - 1, 60).astype(int)
    means, colors = [], []
    for view in views:
        pixels = np.stack([rng.integers(0, side, n_gaussians // len(views) + 1) for side in held.size[::-1]], 1)
        means.append(unproject(held.depth[view], held.Ks[view], held.cam_from_world[view], pixels))
        colors.append(held.images[view][pixels[:, 0], pixels[:, 1]])
    places = np.concatenate(means)[:n_gaussians] + rng.normal(0, 1e-4, (n_gaussians, 3))
    shapes, normals = local_shape(places, 16)
    points = Points(
        held.names, held.Ks, held.cam_from_world, places, np.concatenate(colors)[:n_gaussians], normals, shapes,
        np.zeros((0, 2), np.int32), {"how": "depth"},
    )  # fmt: skip
    settings = {"steps": 3000, "semantics": False, "max_gaussians": 2 * n_gaussians, "weight_depth": 0.8}
    config = Config.model_validate({"train": settings})
    trainer = Trainer(
        model_of(points, None, config.train, config.describe),
        training_views(held, points, None, True), config.train, extent(points.cam_from_world),
    )  # fmt: skip
    trainer.step = int(config.train.steps * 0.1)  # at full resolution, before growth
    rounds = trainer.steps()
    for _ in range(FIRST):
        next(rounds)
    began = time.perf_counter()
    for _ in range(steps):
        next(rounds)
    seconds = (time.perf_counter() - began) / steps
    return {"step_ms": 1e3 * seconds, "peak_gb": shared.peak_memory() / 2**30}


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("scale", __doc__, work=True)
    parser.add_argument("--only", choices=list(GROWTH), nargs="*", default=list(GROWTH))
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--case", nargs=2, help="a capture and a number of Gaussians: measure that alone")
    options = parser.parse_args(arguments)
    if options.case:
        print(json.dumps(measured(Path(options.case[0]), int(options.case[1]), options.steps)))
        return 0
    print(f"chebsplat {chebsplat.__version__} on {shared.processor()}, {os.cpu_count()} cores, load "
          f"{os.getloadavg()[0]:.1f}; bar: 1000 views of 1920×1080 within {BOUND:g} GB")  # fmt: skip
    rows: list[dict[str, Any]] = []
    for name in options.only:
        for n_gaussians, size, n_views in GROWTH[name]:
            with tempfile.TemporaryDirectory(prefix="scale-") as folder:
                capture, stored = enlarged(options.work, size, n_views, Path(folder))
                command = [sys.executable, "-m", "benchmarks", "scale", "--work", str(options.work)]
                command += ["--steps", str(options.steps), "--case", str(capture), str(n_gaussians)]
                done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found = json.loads(done.stdout)
            rows.append({"row": name, "gaussians": n_gaussians, "width": size[0], "height": size[1],
                         "views": n_views, **found, "disk_gb": stored / 2**30})  # fmt: skip
            print(f"{n_gaussians:>9,} Gaussians  {size[0]:>4}×{size[1]:<4}  {n_views:>4} views  "
                  f"{found['step_ms']:7.1f} ms a step  {found['peak_gb']:5.2f} GB  {stored / 2**30:6.3f} GB on disk",
                  flush=True)  # fmt: skip
    for name in options.only:
        some = [row for row in rows if row["row"] == name]
        if len(some) > 1:
            first, last = some[0], some[-1]
            grown = {"Gaussians": last["gaussians"] / first["gaussians"], "views": last["views"] / first["views"],
                     "pixels": last["width"] * last["height"] / (first["width"] * first["height"])}[name]  # fmt: skip
            slopes = (math.log(last[key] / first[key]) / math.log(grown) for key in ("step_ms", "peak_gb", "disk_gb"))
            print("with {}: step ^{:.2f}, memory ^{:.2f}, disk ^{:.2f}".format(name, *slopes))
    shared.write_csv(options.out / "scale.csv", rows)
    return int(any(row["peak_gb"] > BOUND for row in rows if row["views"] == 1000))
