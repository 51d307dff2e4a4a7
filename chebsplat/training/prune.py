"""Semantic-aware pruning: gates, soft masks, and hard ones with a straight-through gradient."""

from __future__ import annotations

from torch import Tensor, nn

MAX_LOGIT = 10.0  # beyond, the sigmoid's gradient is lost in float32
THRESHOLD = 0.1  # of a soft mask: below, a Gaussian or an SH band is closed


class SemanticGate(nn.Module):
    """Pruning logit [N] from semantic features [N, C]; starts open, alike for all.

    Choices: starts at logit 1, m̂ = 0.73, with `prune_logits` at 1 too: from 3 a short training's λ
      does not get any mask below the threshold. The caller detaches the features: they are taught
      by the teacher, not by pruning.
    """

    def __init__(self, n_channels: int, initial: float = 1.0):
        super().__init__()
        self.linear = nn.Linear(n_channels, 1)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, initial)

    def forward(self, features: Tensor) -> Tensor:
        logits: Tensor = self.linear(features)[:, 0]
        return logits


def soft_mask(render_logits: Tensor, semantic_logits: Tensor | None) -> Tensor:
    """m̂ [N] in (0, 1) of the rendering gate's logits [N] and, if any, the semantic gate's.

    Choices: the product, so that either gate alone can remove and neither overrules the other's
      removal; logits are clamped to ±10.
    """
    soft = render_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()
    return (
        soft
        if semantic_logits is None
        else soft * semantic_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()
    )


def hard_mask(soft: Tensor) -> Tensor:
    """Exactly 0 or 1 by THRESHOLD, with the gradient of `soft` (straight-through)."""
    return (soft > THRESHOLD).to(soft.dtype) + (soft - soft.detach())


def apply_mask(mask: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Masked scales [N, 3] and opacities [N], for rendering: no stored value becomes log 0."""
    return scales * mask[:, None], opacities * mask
