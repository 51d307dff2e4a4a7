"""What refreshing regions and descriptors costs in training, and how stale descriptors are between two refreshes.

Usage: python benchmarks/refresh.py --capture DIR --points DIR --features DIR [--out FOLDER]
The artifacts of one scene, from `make scene=NAME stage=describe`. Trains with the default schedule, without growth, to
the end of its half-resolution part; from there on descriptors are left as they are, and compared with fresh ones.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import time
from pathlib import Path
from typing import Any

import chebsplat  # isort: skip  # before torch: a busy machine punishes OpenMP threads that wait actively
import numba
import torch

from chebsplat.formats.capture import read_capture
from chebsplat.formats.features import read_features
from chebsplat.formats.points import read_points
from chebsplat.shape.descriptor import describe_members
from chebsplat.stages.config import Config
from chebsplat.stages.train_inputs import trainer_of
from chebsplat.training.trainer import Trainer

INTERVALS = (25, 50, 100, 200, 400)


def prepared(options: argparse.Namespace) -> Trainer:
    config = Config.model_validate({"train": {"n_densify": 0, "refresh_every": 1_000_000}})
    capture, points = read_capture(options.capture), read_points(options.points)
    return trainer_of(capture, points, read_features(options.features), config.train, config.describe)


def descriptors(trainer: Trainer) -> torch.Tensor:
    """Of the regions as they were sampled last and the Gaussians as they are now."""
    shape, raw = trainer.model.shape, trainer.model.raw
    assert shape is not None
    means, quats, log_scales = (raw[name].detach() for name in ("means", "quats", "log_scales"))
    gaussians = means.numpy(), quats.numpy(), log_scales.exp().numpy()
    return torch.from_numpy(describe_members(*gaussians, shape.members.numpy(), shape.describe).values)


def staleness(old: torch.Tensor, new: torch.Tensor) -> tuple[float, float]:
    """Median and 95th percentile over regions of the largest difference, relative to the largest value."""
    error = (old - new).abs().amax((1, 2, 3)) / new.abs().amax((1, 2, 3)).clamp_min(1e-9)
    return float(error.median()), float(error.quantile(0.95))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("capture", "points", "features"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    trainer = prepared(options)
    begin = round(trainer.settings.encode_from * trainer.settings.steps)
    before, spent, began = torch.zeros(0), 0.0, 0.0
    rows: list[dict[str, Any]] = []
    for _ in trainer.steps():
        step = trainer.step
        if step == begin:
            trainer.refresh()
            before = descriptors(trainer)
            began = time.perf_counter()
        elif step - begin in INTERVALS:
            paused = time.perf_counter()
            median, most = staleness(before, descriptors(trainer))
            spent += time.perf_counter() - paused
            seconds = (paused - began - spent) / (step - begin)
            rows.append({"interval": step - begin, "step_seconds": seconds, "median": median, "p95": most})
            if step - begin == INTERVALS[-1]:
                break
    took = []
    for _ in range(5):
        trainer.model.raw["means"].detach().add_(1e-6)  # every region changes, as it does in training
        now = time.perf_counter()
        trainer.refresh()
        took.append(time.perf_counter() - now)
    now = time.perf_counter()
    descriptors(trainer)
    alone, refresh = time.perf_counter() - now, statistics.median(took)
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__}, numba {numba.__version__}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {len(trainer.model)} Gaussians")
    print(f"refresh {refresh:.3f} s, of which descriptors {alone:.3f} s")
    print("interval   share of training time   staleness: median    95 %")
    for row in rows:
        row["share"] = refresh / (refresh + row["interval"] * row["step_seconds"])
        print(f"{row['interval']:8d} {row['share']:24.1%} {row['median']:19.2e} {row['p95']:9.2e}")
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "refresh.csv").open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
