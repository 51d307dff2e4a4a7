"""A training of a scene that has been run up to its teacher; the benchmarks of training share it."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from chebsplat.cameras import extent
from chebsplat.formats.capture import read_capture
from chebsplat.formats.features import read_features
from chebsplat.formats.points import read_points
from chebsplat.stages.config import Config
from chebsplat.stages.measured_depth import with_depth_loss
from chebsplat.stages.train_inputs import model_of, training_views
from chebsplat.training.trainer import Trainer


def trainer_from(
    work: Path,
    config: Config,
    backend: str = "auto",
    basis: dict[str, Tensor] | None = None,
    device: str = "cpu",
) -> Trainer:
    """A trainer before its first step.

    Args: work: folder of the links `ingest`, `sfm` and, if semantics are trained, `teacher`; backend: of the
          rasterizer; basis: earlier knowledge, as `Trainer` takes it; device: `cpu` or `cuda`.
    """
    capture, points = read_capture(work / "ingest"), read_points(work / "sfm")
    features = read_features(work / "teacher") if config.train.semantics else None
    train, _ = with_depth_loss(config.train, capture, points)
    model = model_of(points, features, train, config.describe, device, backend)
    views = training_views(capture, points, features, bool(train.weight_depth)).to(device)
    return Trainer(model, views, train, extent(points.cam_from_world), basis=basis)
