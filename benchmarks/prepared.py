"""A training of a scene whose artifacts `make scene=... stage=...` has linked; the benchmarks of training share it."""

from __future__ import annotations

from pathlib import Path

from chebsplat.formats.capture import read_capture
from chebsplat.formats.features import read_features
from chebsplat.formats.points import read_points
from chebsplat.stages.config import Config
from chebsplat.stages.train_inputs import trainer_of
from chebsplat.training.trainer import Trainer


def prepared(work: Path, config: Config, backend: str = "auto") -> Trainer:
    """Before its first step; `work` holds the links `ingest`, `sfm` and, if semantics are trained, `teacher`."""
    capture, points = read_capture(work / "ingest"), read_points(work / "sfm")
    features = read_features(work / "teacher") if config.train.semantics else None
    return trainer_of(capture, points, features, config.train, config.describe, backend)
