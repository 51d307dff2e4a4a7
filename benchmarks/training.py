"""A training of a scene without the shape branch: seconds, and PSNR of the test views, by backend.

Trains once in full on the cpu backend, then again with few steps on both cpu and reference, which see the same views,
seeds and schedules. Test views are looked at once, at the end of each training.

Usage: python benchmarks/training.py --work work/office0 [--steps 3000] [--equal-steps 200] [--out build/bench]
The folder holds the links `ingest`, `sfm` and `teacher`, from `make scene=office0 set=teacher.kind=labels stage=...`.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from prepared import prepared

from chebsplat.formats.capture import read_capture
from chebsplat.formats.points import read_points
from chebsplat.stages.config import Config
from chebsplat.views import Views

NEVER = 1_000_000  # steps


def test_views(work: Path) -> Views:
    capture, points = read_capture(work / "ingest"), read_points(work / "sfm")
    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if capture.is_test[row[name]]]
    images = capture.images[:][[row[points.names[k]] for k in used]]
    cameras = [torch.from_numpy(a[used]).float() for a in (points.Ks, points.cam_from_world)]
    return Views([points.names[k] for k in used], torch.from_numpy(images), *cameras)


def train(work: Path, backend: str, steps: int, seed: int) -> dict[str, Any]:
    settings = {"steps": steps, "seed": seed, "encoder": "off", "max_gaussians": 20_000, "refresh_every": NEVER}
    trainer = prepared(work, Config.model_validate({"train": settings}), backend)
    began = time.perf_counter()
    for _ in trainer.steps():
        pass
    seconds = time.perf_counter() - began
    trainer.views = test_views(work)
    psnr = trainer.held_in_psnr(list(range(len(trainer.views.names))))
    found = {"backend": backend, "steps": steps, "seed": seed, "seconds": seconds, "psnr": psnr}
    return found | {"gaussians": len(trainer.model), "channels": trainer.model.raw["features"].shape[-1]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--equal-steps", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
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
    with open(options.out / "training.csv", "w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
