"""The lift of a teacher's features to a finished scene: seconds beside their bar, and the error of one view.

Every form lifts all views of the scene and averages them, with compiled kernels and maps that are in memory. They take
turns, and the fastest round of each counts; processor seconds, of all threads, tell what a busy machine hides. The
error is against float64, on a scene of 300 Gaussians.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

import numba
import numpy as np
import torch

import chebsplat
from benchmarks import shared
from chebsplat.formats.capture import read_capture
from chebsplat.formats.features import read_features
from chebsplat.formats.gaussians import read_gaussians
from chebsplat.lifting.cell_maps import to_cells
from chebsplat.lifting.observations import Observations, estimate, gathered
from chebsplat.rasterize import lift_reference
from chebsplat.rasterize.lift import lift
from chebsplat.splats.gaussians import activated

BAR = 4.0  # seconds, of all forms
ERROR_BAR = 1e-5
FORMS = {"mean": (0.0, 0), "gate": (0.05, 0), "gate and median": (0.05, 5)}  # the gate, and steps of the median


def error() -> float:
    """Largest difference of mean features, relative to the largest feature, over gates of 0 to 1."""
    rng, size = np.random.default_rng(0), (83, 61)
    n, cells = 300, (16, 21)
    gaussians = (
        rng.uniform([-1.5, -1, 1], [1.5, 1, 4], (n, 3)).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        rng.uniform(0.01, 0.16, (n, 3)).astype(np.float32),
        rng.uniform(0.05, 0.95, n).astype(np.float32),
    )
    K = np.array([[45.0, 0, size[0] / 2], [0, 42, size[1] / 2], [0, 0, 1]])
    values, counts = rng.normal(size=(*cells, 32)).astype(np.float32), rng.random(cells).astype(np.float32)
    worst = 0.0
    for gate in (0.0, 0.1, 0.5, 1.0):
        given = gaussians, np.eye(4), K, size, values, counts, gate
        found, (weights, sums) = lift(*given), lift_reference.lift(*given)
        expected = sums[found.ids] / weights[found.ids, None]
        worst = max(worst, float(np.abs(found.sums / found.weights[:, None] - expected).max() / np.abs(expected).max()))
    return worst


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("lift", __doc__, work=True)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    numba.set_num_threads(options.threads)
    capture, scene = read_capture(options.work / "ingest"), read_gaussians(options.work / "train")
    features = read_features(options.work / "teacher")
    raw = {name: torch.from_numpy(values) for name, values in scene.parameters.items()}
    means, quats, scales, opacities = (part.numpy() for part in activated(raw))
    gaussians = means, quats, scales, opacities
    row, cameras = {name: k for k, name in enumerate(features.names)}, scene.cameras
    maps = [features.features[row[name]] for name in cameras.names]

    def observed(gate: float) -> Observations:
        views = (
            lift(gaussians, pose, K, capture.size, *to_cells(said, np.ones(said.shape[:2]), capture.size), gate)
            for said, pose, K in zip(maps, cameras.cam_from_world, cameras.Ks, strict=True)
        )
        return gathered(len(gaussians[0]), maps[0].shape[-1], views)

    best = dict.fromkeys(FORMS, np.inf)
    spent, sizes = dict.fromkeys(FORMS, np.inf), dict.fromkeys(FORMS, 0)
    for _ in range(options.rounds + 1):  # the first compiles
        for name, (gate, steps) in FORMS.items():
            began, used = time.perf_counter(), time.process_time()
            observations = observed(gate)
            estimate(observations, steps)
            best[name] = min(best[name], time.perf_counter() - began)
            spent[name] = min(spent[name], time.process_time() - used)
            sizes[name] = len(observations.views)
    width, height = capture.size
    print(f"chebsplat {chebsplat.__version__}, numba {numba.__version__}, {shared.processor()}")
    print(f"{options.threads} threads of {os.cpu_count()}, load {os.getloadavg()[0]:.1f}; {len(gaussians[0]):,} "
          f"Gaussians, {len(maps)} views of {width}×{height}, {maps[0].shape[-1]} channels")  # fmt: skip
    largest, rows = error(), []
    for name, seconds in best.items():
        print(
            f"{name:<16} {seconds:6.2f} s (bar {BAR:.0f} s), {spent[name]:.2f} of processors; {sizes[name]:,} observed"
        )
        rows.append(
            {
                "form": name,
                "seconds": seconds,
                "processor_seconds": spent[name],
                "bar": BAR,
                "observations": sizes[name],
            }
        )
    print(f"largest difference from float64, relative: {largest:.1e} (bar {ERROR_BAR:.0e})")
    shared.write_csv(options.out / "lift.csv", [row | {"error": largest} for row in rows])
    return int(max(best.values()) > BAR or largest > ERROR_BAR)
