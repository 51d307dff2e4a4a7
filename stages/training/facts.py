"""Facts of a finished training, for its manifest."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from chebsplat.formats.features import Features
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.command import Job
from chebsplat.training.printed import PrintedScene
from chebsplat.training.trainer import Trainer


def facts_of(job: Job, trainer: Trainer, parameters: dict[str, np.ndarray]) -> dict[str, Any]:
    """Facts of a finished training with these final parameters: their number, seconds, memory."""
    timed = max(trainer.step - 1, 1)  # all but the first
    facts: dict[str, Any] = {"n_gaussians": parameters["degrees"].size, "steps": trainer.step}
    facts["seconds_per_step"] = trainer.seconds / timed
    if job.device == "cuda":
        facts["peak_device_bytes"] = torch.cuda.max_memory_allocated()
    facts["milliseconds"] = {
        part: 1e3 * seconds / timed for part, seconds in trainer.laps.seconds.items()
    }
    return facts


def printed_facts(model: PrintedScene, features: Features) -> dict[str, Any]:
    """Facts of a printed training: histograms of gates and masks, and accuracy of encodings.

    `agreement`: share of Gaussians whose label by shape features equals that by their own;
    `commonest`: share with the commonest label, the agreement of a constant encoder;
    `ranks_before`: of the bases of the scenes before.
    """
    whole = model.whole()
    named, own = (
        decode_labels(values.detach().cpu().numpy(), features.label_embeddings)
        for values in (whole.shape, model.raw["features"])
    )
    facts = {"histograms": model.histograms(), "agreement": float((named == own).mean())}
    facts["commonest"] = float(np.bincount(own).max() / len(own))
    return facts | {"ranks_before": {name: basis.shape[1] for name, basis in model.bases.items()}}
