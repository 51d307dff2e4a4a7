"""The loss of rendered features: distance to the teacher's, or cross-entropy on logits where it brings labels."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.settings import TrainSection
from chebsplat.training.losses import cell_shares, feature_distance
from chebsplat.views import TaughtLabels

TEMPERATURE = 0.1  # of the logits that cross-entropy is of


def semantic_loss(
    render: Tensor,
    features: Tensor,
    labels: TaughtLabels | None,
    mask: Tensor | None,
    settings: TrainSection,
    backend: str = "auto",
) -> Tensor:
    """What a view's rendered features [H, W, C] cost, by `train.feature_loss`; cells without a label cost nothing.

    Args: features [h, w, C] and labels of the teacher; mask [H, W], true where a pixel counts, or None;
      backend: of `rasterize`.
    Raises: ValueError where cross-entropy is asked for without labels.
    """
    if settings.feature_loss == "cross-entropy":
        if labels is None:
            raise ValueError("cross-entropy needs labels with a confidence")
        return label_entropy(render, labels, mask, TEMPERATURE)
    counted = None if labels is None or labels.complete else labels.classes >= 0
    return feature_distance(render, features, mask, settings.feature_loss or "length", counted, backend)


def label_entropy(render: Tensor, labels: TaughtLabels, mask: Tensor | None, temperature: float) -> Tensor:
    """Cross-entropy of labels on the logits render · class codes / temperature, weighted by confidence.

    Args: render [H, W, C], as accumulated: a pixel that little covers has logits near 0; labels of h × w cells, h ≤ H;
      mask [H, W], as of `feature_distance`.
    Returns: the mean over cells that have a label, 0 where none has one.
    Choices: the render is averaged over each cell, as in `feature_distance`. The mean is over cells, not over
      confidences: a view of which the teacher is unsure teaches less than another, as in Panoptic Lifting.
    """
    size = (labels.classes.shape[0], labels.classes.shape[1])
    pooled = torch.nn.functional.adaptive_avg_pool2d(render.permute(2, 0, 1), size).permute(1, 2, 0)
    logits = pooled @ labels.class_codes.to(render.dtype).T / temperature
    log_likelihood = logits.log_softmax(-1).gather(-1, labels.classes.clamp_min(0)[..., None])[..., 0]
    counted = labels.classes >= 0
    share = cell_shares(mask, size, render, counted) * labels.confidence.to(render.dtype)
    return -torch.where(counted & (share > 0), share * log_likelihood, 0.0).sum()
