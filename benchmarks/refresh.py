"""What refreshing regions and descriptors costs in training, and how stale descriptors are between two refreshes.

Trains with the default schedule, without growth, to the end of its half-resolution part; from there on descriptors are
left as they are, and compared with fresh ones.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence
from typing import Any

import numba
import torch

import chebsplat
from benchmarks import shared
from benchmarks.scene import trainer_from
from chebsplat.shape.descriptor import describe_members
from chebsplat.stages.config import Config
from chebsplat.training.trainer import Trainer

INTERVALS = (25, 50, 100, 200, 400)


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


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("refresh", __doc__, work=True)
    options = parser.parse_args(arguments)
    train = {"encoder": "transformer", "n_densify": 0, "refresh_every": 1_000_000}
    trainer = trainer_from(options.work, Config.model_validate({"train": train}))
    begin = round(trainer.settings.encode_from * trainer.schedule.steps)
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
    shared.write_csv(options.out / "refresh.csv", rows)
