"""A training of a scene without the shape branch: seconds, and PSNR of the test views, by backend.

Trains once in full on the cpu backend, then again with few steps on both cpu and reference, which see the same views,
seeds and schedules. Test views are looked at once, at the end of each training.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from benchmarks import shared
from benchmarks.scene import trainer_from
from chebsplat.evaluation.metrics import psnr
from chebsplat.formats.capture import read_capture
from chebsplat.formats.points import read_points
from chebsplat.stages.config import Config
from chebsplat.training.model import SceneModel
from chebsplat.views import Views

NEVER = 1_000_000  # steps


def test_views(work: Path) -> Views:
    capture, points = read_capture(work / "ingest"), read_points(work / "sfm")
    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if capture.is_test[row[name]]]
    images = capture.images[:][[row[points.names[k]] for k in used]]
    cameras = [torch.from_numpy(a[used]).float() for a in (points.Ks, points.cam_from_world)]
    return Views([points.names[k] for k in used], torch.from_numpy(images), *cameras)


@torch.no_grad()
def mean_psnr(model: SceneModel, views: Views, degree: int) -> float:
    """Mean over views of the PSNR of 8-bit images, dB; degree: of the spherical harmonics."""
    scores = []
    for k in range(len(views.names)):
        image = model.render(views.camera(k, 1), degree, semantic=False).rgb.clamp(0, 1)
        scores.append(psnr((image * 255).round().byte().numpy(), views.images[k].numpy()))
    return float(np.mean(scores))


def train(work: Path, backend: str, steps: int, seed: int) -> dict[str, Any]:
    settings = {"steps": steps, "seed": seed, "encoder": "off", "max_gaussians": 20_000, "refresh_every": NEVER}
    trainer = trainer_from(work, Config.model_validate({"train": settings}), backend)
    began = time.perf_counter()
    for _ in trainer.steps():
        pass
    seconds = time.perf_counter() - began
    row = {"backend": backend, "steps": steps, "seed": seed, "seconds": seconds}
    row |= {"psnr": mean_psnr(trainer.model, test_views(work), trainer.schedule.degree(1.0))}
    return row | {"gaussians": len(trainer.model), "channels": trainer.model.raw["features"].shape[-1]}


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("train", __doc__, work=True)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--equal-steps", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args(arguments)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; torch {torch.__version__} on "
          f"{torch.get_num_threads()} threads, numba {numba.__version__} on {numba.get_num_threads()}")  # fmt: skip
    wanted = [("cpu", options.steps, 0)]
    wanted += [(b, options.equal_steps, s) for s in range(options.seeds) for b in ("cpu", "reference")]
    rows = []
    for backend, steps, seed in wanted if options.equal_steps else wanted[:1]:
        rows.append(train(options.work, backend, steps, seed))
        print(
            "  ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()), flush=True
        )
    print(f"seconds of {options.steps} steps: {rows[0]['seconds']:.1f}, bar <= 75")
    pairs = zip(rows[1::2], rows[2::2], strict=True)
    gaps = [abs(cpu["psnr"] - exact["psnr"]) for cpu, exact in pairs]
    if gaps:
        print(
            f"PSNR of cpu against reference after {options.equal_steps} steps: {np.max(gaps):.3f} dB apart, bar <= 0.2"
        )
    shared.write_csv(options.out / "training.csv", rows)
