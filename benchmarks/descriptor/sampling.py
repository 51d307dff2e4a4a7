"""Run time of sampling regions, and of the describe stage as a whole process, by number of points."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.points import SCHEMA, Points, write_points
from chebsplat.shape.regions import build_regions, covering, farthest_points


def best(action: Callable[[], object], repeats: int = 3) -> float:
    """Seconds of the fastest call, after one that warms up."""
    action()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return min(times)


def sampling_rows() -> list[dict[str, Any]]:
    rows = []
    for n in (10_000, 100_000, 1_000_000):
        points = np.random.default_rng(0).random((n, 3)) * [5.0, 4.0, 0.3]
        regions = build_regions(points, 2048, 64)
        where = points[regions.centers]
        actions: dict[str, Callable[[], object]] = {
            "farthest points, 2048": lambda p=points: farthest_points(p, 2048, 0),
            "regions, 2048 of 64": lambda p=points: build_regions(p, 2048, 64),
            "regions, centres held": lambda p=points, r=regions: build_regions(p, 2048, 64, earlier=r),
            "covering, 4 a point": lambda p=points, r=regions, w=where: covering(p, w, r.radius, 4),
        }
        rows += [{"n": n, "what": what, "ms": 1e3 * best(action, 2)} for what, action in actions.items()]
    return rows


def stage_rows() -> list[dict[str, Any]]:
    """The describe stage as a process of its own, all cores."""
    rows = []
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    with tempfile.TemporaryDirectory() as folder:
        for n in (100_000, 1_000_000):
            rng = np.random.default_rng(0)
            factor = rng.standard_normal((n, 3, 3)) * 0.02
            shapes = (factor @ factor.transpose(0, 2, 1) + 1e-6 * np.eye(3)).astype(np.float32)
            means, colors = rng.random((n, 3)) * [5, 4, 0.3], np.zeros((n, 3), np.uint8)
            normals, tracks = np.tile(np.float32([0, 0, 1]), (n, 1)), np.zeros((0, 2), np.int32)
            view = (["a"], np.eye(3)[None], np.eye(4)[None])
            path = Path(folder) / f"points-{n}"
            with artifact.publish(path, Manifest(SCHEMA, "0" * 16, "sfm")) as tmp:
                write_points(tmp, Points(*view, means, colors, normals, shapes, tracks))
            for text in ("", "[describe]\nn_regions = 2048\nregion_size = 64\n"):
                config, what = Path(folder) / "c.toml", "2048 of 64" if text else "default regions"
                config.write_text(text)
                seconds = []
                for k in range(2):
                    call = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", "describe"]
                    call += ["--in-points", str(path), "--config", str(config), "--log-level", "error"]
                    call += ["--out", f"{folder}/out-{n}-{len(text)}-{k}", "--device", "cpu"]
                    began = time.perf_counter()
                    subprocess.run(call, check=True, env=environment, stdout=subprocess.DEVNULL)
                    seconds.append(time.perf_counter() - began)
                rows.append({"n": n, "what": f"describe stage, {what}", "ms": 1e3 * min(seconds)})
    return rows
