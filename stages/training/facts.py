"""Facts of a finished training, for its manifest."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from chebsplat.formats.features import Features
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.command import Job
from chebsplat.training.trainer import Trainer

FEW = 20  # a class of fewer Gaussians has no mean worth comparing


def facts_of(
    job: Job, trainer: Trainer, parameters: dict[str, np.ndarray], features: Features | None
) -> dict[str, Any]:
    """Facts of a finished training with these final parameters: what shape and semantics changed, seconds, memory."""
    model = trainer.model
    facts: dict[str, Any] = {}
    if model.shape is not None:
        facts["described_anew"] = model.shape.described.share_described
        if trainer.settings.inflation == 0:
            facts["guarded"] = model.shape.share_undefined
        if features is not None:
            alone = model.shape.alone().cpu().numpy()
            facts["encoder"] = agreement(alone, parameters["features"], features.label_embeddings)
    if features is not None:
        mask = trainer.final_mask()
        soft = None if mask is None else mask.cpu().numpy()
        facts["guidance"] = guidance(parameters, soft, features.label_embeddings)
    timed = max(trainer.step - 1, 1)  # all but the first
    facts |= {"n_gaussians": parameters["degrees"].size, "steps": trainer.step}
    facts["seconds_per_step"] = trainer.seconds / timed
    if job.device == "cuda":
        facts["peak_device_bytes"] = torch.cuda.max_memory_allocated()
    facts["milliseconds"] = {part: 1e3 * seconds / timed for part, seconds in trainer.laps.seconds.items()}
    return facts


def agreement(alone: np.ndarray, features: np.ndarray, embeddings: np.ndarray) -> dict[str, float]:
    """What encodings alone know: of the Gaussians, the part whose label [L, C] by them is that by their own features,
    and the part that has the commonest label, which an encoder that knows nothing reaches.
    """
    named, wanted = decode_labels(alone, embeddings), decode_labels(features, embeddings)
    return {"agreement": float((named == wanted).mean()), "commonest": float(np.bincount(wanted).max() / len(wanted))}


def guidance(
    parameters: dict[str, np.ndarray], mask: np.ndarray | None, embeddings: np.ndarray
) -> dict[str, float | None]:
    """What shape and semantics changed: labels, and which Gaussians and SH bands go.

    Args: parameters: of a finished training; mask [N]: m̂ of its Gaussians, None without pruning; embeddings [L, C].
    Returns: `labels_changed`, the part of Gaussians whose label the fusion changed; `mask_spread` and `band_spread`,
      standard deviations over classes of the mean m̂ and of the mean share of SH coefficients kept. None: not there.
    """
    own = decode_labels(parameters["features"], embeddings)
    fused = decode_labels(parameters["fused"], embeddings) if "fused" in parameters else own

    def spread(values: np.ndarray) -> float:
        counts, sums = np.bincount(fused), np.bincount(fused, values)
        return float((sums / np.maximum(counts, 1))[counts >= FEW].std()) if (counts >= FEW).any() else 0.0

    kept = (parameters["degrees"].astype(np.float64) + 1) ** 2 / 16
    return {
        "labels_changed": float((own != fused).mean()) if "fused" in parameters else None,
        "mask_spread": None if mask is None else spread(mask.astype(np.float64)),
        "band_spread": spread(kept),
    }
