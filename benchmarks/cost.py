"""What the joint method costs: seconds of whole trainings, as a multiple of plain 3DGS.

Usage: python benchmarks/cost.py --work work/office0 [--steps 3000] [--ablations no-shape]
The folder holds the links `ingest`, `sfm` and `teacher`, from `make scene=office0 stage=...`. The trainings take turns
of fifty steps, so that other load on the machine meets all alike.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from pathlib import Path

import chebsplat  # isort: skip  # before torch: a busy machine punishes OpenMP threads that wait actively
import torch

from chebsplat.cameras import extent
from chebsplat.formats.capture import read_capture
from chebsplat.formats.features import read_features
from chebsplat.formats.points import read_points
from chebsplat.gaussians import initial_gaussians
from chebsplat.model import SceneModel
from chebsplat.stages.config import Config
from chebsplat.stages.train_inputs import training_views
from chebsplat.trainer import Trainer

ABLATIONS = Path(__file__).parents[1] / "pipelines" / "configs" / "ablations"
BAR, TURN = 1.6, 50


def trainer_of(work: Path, ablation: str, steps: int) -> Trainer:
    given = tomllib.loads((ABLATIONS / f"{ablation}.toml").read_text()) if ablation != "full" else {}
    config = Config.model_validate(given)
    train, describe = config.train.model_dump() | {"steps": steps}, config.describe.model_dump()
    capture, points = read_capture(work / "ingest"), read_points(work / "sfm")
    features = read_features(work / "teacher") if train["semantics"] else None
    torch.manual_seed(0)
    raw = initial_gaussians(points.means, points.colors, points.covariances)
    model = SceneModel(raw, describe, train, None if features is None else features.features.shape[-1])
    views = training_views(capture, points, features)
    trainer = Trainer(model, views, train, describe, extent(points.cam_from_world), {})
    trainer.refresh()
    return trainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=Config().train.steps)
    parser.add_argument("--ablations", nargs="*", default=[])
    options = parser.parse_args()
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__} on {torch.get_num_threads()} threads; "
          f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; bar {BAR}")  # fmt: skip
    trainers = {name: trainer_of(options.work, name, options.steps) for name in ("plain", "full", *options.ablations)}
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


if __name__ == "__main__":
    main()
