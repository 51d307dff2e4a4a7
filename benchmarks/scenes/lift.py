"""The lift of a teacher's features to a finished scene: seconds beside their bar.

Every form lifts all views of the scene and averages them, with compiled kernels and maps that are
in memory. They take turns, and the fastest round of each counts; processor seconds, of all threads,
tell what a busy machine hides.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch

from benchmarks import shared
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.kernels.threads import set_n_threads
from chebsplat.lifting.observations import Observations, estimate, gathered, to_cells
from chebsplat.rasterize.lift import lift
from chebsplat.splats.gaussians import activated

BAR = 4.0  # seconds, of all forms
# the gate, and steps of the median
FORMS = {"mean": (0.0, 0), "gate": (0.05, 0), "gate and median": (0.05, 5)}


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("lift", __doc__, work=True)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    set_n_threads(options.threads)
    capture, scene = Capture.read(options.work / "ingest"), Gaussians.read(options.work / "train")
    features = Features.read(options.work / "teacher")
    raw = {name: torch.from_numpy(values) for name, values in scene.parameters.items()}
    means, quats, scales, opacities = (part.numpy() for part in activated(raw))
    gaussians = means, quats, scales, opacities
    row, cameras = {name: k for k, name in enumerate(features.names)}, scene.cameras
    maps = [features.features[row[name]] for name in cameras.names]

    def observed(gate: float) -> Observations:
        views = (
            lift(
                gaussians,
                pose,
                K,
                capture.size,
                *to_cells(grid, np.ones(grid.shape[:2]), capture.size),
                gate,
            )
            for grid, pose, K in zip(maps, cameras.cam_from_world, cameras.Ks, strict=True)
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
    print(shared.machine())
    print(
        f"{len(gaussians[0]):,} Gaussians, {len(maps)} views of {width}×{height}, "
        f"{maps[0].shape[-1]} channels"
    )
    rows = []
    for name, seconds in best.items():
        print(
            f"{name:<16} {seconds:6.2f} s, {spent[name]:.2f} of processors; "
            f"{sizes[name]:,} observed"
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
    shared.write_csv(options.out / "lift.csv", rows)
    bars = [(f"{name}, s", seconds, "<=", BAR) for name, seconds in best.items()]
    return int(not all(shared.judged(bars)))
