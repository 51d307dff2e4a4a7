"""What the knowledge space costs a training: its regulariser in every step, its update after the last one.

Usage: python benchmarks/knowledge.py --work work/office0 [--turns 60] [--out build/bench]
The folder holds the links `ingest`, `sfm` and `teacher`, from `make scene=office0 stage=...`. Steps with and without
the regulariser take turns in one training at full resolution, so that other load on the machine meets both alike; a
turn lasts from one step that encodes regions anew to the next.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import time
from pathlib import Path

import chebsplat  # isort: skip  # before torch: a busy machine punishes OpenMP threads that wait actively
import torch
from prepared import prepared

from chebsplat.shape import cks
from chebsplat.stages.config import Config

BAR = 3.0  # per cent of the time of training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--turns", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__} on {torch.get_num_threads()} threads; "
          f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")  # fmt: skip
    train = {"coarse_until": 0.0, "encode_from": 0.0, "n_densify": 0, "refresh_every": 1_000_000}
    trainer = prepared(options.work, Config.model_validate({"train": train}))
    assert trainer.model.shape is not None
    weights = trainer.model.shape.encoder.attention_weights()
    began = time.perf_counter()
    bases = {name: cks.update(None, W.detach())[0] for name, W in weights.items()}
    update = time.perf_counter() - began
    times: dict[bool, list[float]] = {False: [], True: []}
    rounds, period = trainer.steps(), trainer.settings.encode_every
    for turn in range(2 * options.turns + 10):
        trainer.basis = bases if turn % 2 else {}
        before = trainer.seconds
        for _ in range(period):
            next(rounds)
        if turn >= 10:  # kernels are compiled and caches warm
            times[bool(turn % 2)].append((trainer.seconds - before) / period)
    alone = []
    for _ in range(200):
        began = time.perf_counter()
        cks.basis_loss(trainer.model.shape.encoder.attention_weights(), bases).backward()
        alone.append(time.perf_counter() - began)
    without, with_it = (statistics.median(times[which]) for which in (False, True))
    n_steps = trainer.settings.steps
    share = 100 * (statistics.median(alone) * n_steps + update) / (without * n_steps)
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
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "knowledge.csv").open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(found))
        writer.writeheader()
        writer.writerow(found)


if __name__ == "__main__":
    main()
