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

FEW = 20  # a class of fewer Gaussians has no mean worth comparing


def facts_of(
    job: Job, trainer: Trainer, parameters: dict[str, np.ndarray], features: Features | None
) -> dict[str, Any]:
    """Facts of a finished training with these final parameters: guidance, seconds, memory."""
    facts: dict[str, Any] = {}
    if features is not None:
        mask = trainer.final_mask()
        soft = None if mask is None else mask.cpu().numpy()
        facts["guidance"] = guidance(parameters, soft, features.label_embeddings)
    timed = max(trainer.step - 1, 1)  # all but the first
    facts |= {"n_gaussians": parameters["degrees"].size, "steps": trainer.step}
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


def guidance(
    parameters: dict[str, np.ndarray], mask: np.ndarray | None, embeddings: np.ndarray
) -> dict[str, float | None]:
    """Influence of semantics on the pruning of Gaussians and SH bands, by the spread over classes.

    Args: parameters: of a finished training; mask [N]: m̂ of its Gaussians, None without pruning;
      embeddings [L, C].
    Returns: `mask_spread` and `band_spread`, standard deviations over classes of the mean m̂ (None
      without) and of the mean share of SH coefficients left.
    """
    labels = decode_labels(parameters["features"], embeddings)

    def spread(values: np.ndarray) -> float:
        counts, sums = np.bincount(labels), np.bincount(labels, values)
        return (
            float((sums / np.maximum(counts, 1))[counts >= FEW].std())
            if (counts >= FEW).any()
            else 0.0
        )

    band_share = (parameters["degrees"].astype(np.float64) + 1) ** 2 / 16
    return {
        "mask_spread": None if mask is None else spread(mask.astype(np.float64)),
        "band_spread": spread(band_share),
    }
