"""Pruning: soft masks, and hard ones with a straight-through gradient."""

from __future__ import annotations

from torch import Tensor

MAX_LOGIT = 10.0  # beyond, the sigmoid's gradient is lost in float32
THRESHOLD = 0.1  # of a soft mask: below, a Gaussian or an SH band is closed


def soft_mask(logits: Tensor) -> Tensor:
    """m̂ [N] in (0, 1) of pruning logits [N], which are clamped to ±10."""
    return logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()


def hard_mask(soft: Tensor) -> Tensor:
    """Exactly 0 or 1 by THRESHOLD, with the gradient of `soft` (straight-through)."""
    return (soft > THRESHOLD).to(soft.dtype) + (soft - soft.detach())


def apply_mask(mask: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Masked scales [N, 3] and opacities [N], for rendering: no stored value becomes log 0."""
    return scales * mask[:, None], opacities * mask
