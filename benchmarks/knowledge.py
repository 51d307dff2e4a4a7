"""What the knowledge space costs a training: its regulariser where regions are encoded, its update after the last step.

Two trainings at full resolution, with and without the regulariser, take turns, so that other load on the machine meets
both alike; a turn lasts from one step that encodes regions anew to the next.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence

import torch

import chebsplat
from benchmarks import shared
from benchmarks.scene import trainer_from
from chebsplat.shape import cks
from chebsplat.stages.config import Config

BAR = 3.0  # per cent of the time of training


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("knowledge", __doc__, work=True)
    parser.add_argument("--turns", type=int, default=60)
    options = parser.parse_args(arguments)
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__} on {torch.get_num_threads()} threads; "
          f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")  # fmt: skip
    train = {
        "encoder": "transformer",
        "coarse_until": 0.0,
        "encode_from": 0.0,
        "n_densify": 0,
        "refresh_every": 1_000_000,
    }
    config = Config.model_validate({"train": train})
    plain = trainer_from(options.work, config)
    assert plain.model.shape is not None
    weights = plain.model.shape.encoder.linear_maps()
    began = time.perf_counter()
    bases = {name: cks.update(None, W.detach())[0] for name, W in weights.items()}
    update = time.perf_counter() - began
    times: dict[bool, list[float]] = {False: [], True: []}
    trainers = plain, trainer_from(options.work, config, basis=bases)
    steps, period = [trainer.steps() for trainer in trainers], plain.settings.encode_every
    for turn in range(2 * options.turns + 10):
        trainer, began = trainers[turn % 2], trainers[turn % 2].seconds
        for _ in range(period):
            next(steps[turn % 2])
        if turn >= 10:  # kernels are compiled and caches warm
            times[bool(turn % 2)].append((trainer.seconds - began) / period)
    alone = []
    for _ in range(200):
        began = time.perf_counter()
        cks.basis_loss(plain.model.shape.encoder.linear_maps(), bases).backward()
        alone.append(time.perf_counter() - began)
    without, with_it = (statistics.median(times[which]) for which in (False, True))
    n_steps = plain.settings.steps
    share = 100 * (statistics.median(alone) * n_steps / period + update) / (without * n_steps)
    found = {
        "weights": len(bases),
        "step_ms": 1e3 * without,
        "step_with_ms": 1e3 * with_it,
        "regulariser_ms": 1e3 * statistics.median(alone),
        "update_s": update,
        "overhead_percent": share,
    }
    print("  ".join(f"{k} {v:.3g}" for k, v in found.items()))
    print(f"knowledge in a training of {n_steps} steps: {share:.1f} % of its time, bar <= {BAR:g}")
    print(f"by steps with and without: {100 * (with_it / without - 1):+.1f} %")
    shared.write_csv(options.out / "knowledge.csv", [found])
