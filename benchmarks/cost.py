"""What the joint method costs: seconds of whole trainings, as a multiple of plain 3DGS.

The trainings take turns of fifty steps, so that other load on the machine meets all alike; a short training of each
goes before, so that no kernel is left to compile.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import torch

import chebsplat
from benchmarks import shared
from benchmarks.scene import trainer_from
from chebsplat.pipelines.plan import merged
from chebsplat.pipelines.scenes import read_toml
from chebsplat.settings import MOST_STEPS
from chebsplat.stages.config import Config
from chebsplat.training.trainer import Trainer

BAR, TURN, REHEARSAL = 1.25, 50, 100


def begun(work: Path, ablation: str, steps: int) -> Trainer:
    values = read_toml("ablations", ablation) if ablation != "full" else {}
    return trainer_from(work, Config.model_validate(merged(values, {"train": {"steps": steps}})))


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("cost", __doc__, work=True)
    parser.add_argument("--steps", type=int, default=MOST_STEPS)
    parser.add_argument("--ablations", nargs="*", default=[])
    options = parser.parse_args(arguments)
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__} on {torch.get_num_threads()} threads; "
          f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; bar {BAR}")  # fmt: skip
    variants = ("plain", "full", *options.ablations)
    for name in variants:
        for _ in begun(options.work, name, REHEARSAL).steps():
            pass
    trainers = {name: begun(options.work, name, options.steps) for name in variants}
    rounds = {name: trainer.steps() for name, trainer in trainers.items()}
    for done in range(0, options.steps, TURN):
        for steps in rounds.values():
            for _ in range(min(TURN, options.steps - done)):
                next(steps)
        if (done + TURN) % 500 == 0 or done + TURN >= options.steps:
            print(f"after {min(done + TURN, options.steps)} steps")
            for name, trainer in trainers.items():
                ratio = trainer.seconds / trainers["plain"].seconds
                parts = "  ".join(f"{part} {1e3 * s / trainer.step:.1f}" for part, s in trainer.laps.seconds.items())
                print(f"  {name:12s} {1e3 * trainer.seconds / trainer.step:6.1f} ms a step  ×{ratio:.2f}  {parts}")
