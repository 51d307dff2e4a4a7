"""Semantic-aware pruning: gates, soft masks, and hard ones with a straight-through gradient."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

MAX_LOGIT = 10.0  # beyond, the sigmoid's gradient is lost in float32
MAX_FEATURE = 1e3
THRESHOLD = 0.1  # of a soft mask: below, a Gaussian or an SH band is closed


class SemanticGate(nn.Module):
    """Pruning logit [N] from semantic features [N, C]; starts open, alike for all.

    Choices: starts at logit 1, m̂ = 0.73, with `prune_logits` at 1 too: from 3 a short training's λ does not get any
      mask below the threshold. The caller detaches the features: they are taught by the teacher, not by pruning.
    """

    def __init__(self, n_channels: int, initial: float = 1.0):
        super().__init__()
        self.linear = nn.Linear(n_channels, 1)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, initial)

    def forward(self, features: Tensor) -> Tensor:
        logits: Tensor = self.linear(features)[:, 0]
        return logits


class PrintedGate(nn.Module):
    """The paper's two gates in a row: m̂ [N] of fused features f [N, C] and pruning logits φ [N].

        f′ = σ(W₁ f + b₁) ⊙ f,    u = [f′, φ],    h = σ(W₂ u + b₂) ⊙ u,    m̂ = σ(w · h + b)

    Choices: the second gating network has the form of the first, of which the paper gives the layers in words only. The
      gates start half open and w on φ alone, so that a logit of 1 gives the m̂ that `soft_mask` starts with, alike for
      all. φ is clamped to ±10 and features to ±1000, which unit vectors never reach: products of larger ones overflow
      in the weights' gradients. The caller detaches the features.
    """

    def __init__(self, n_channels: int):
        super().__init__()
        self.gate_features = nn.Linear(n_channels, n_channels)
        self.gate_hidden = nn.Linear(n_channels + 1, n_channels + 1)
        self.output = nn.Linear(n_channels + 1, 1)
        for part in (self.gate_features, self.gate_hidden, self.output):
            nn.init.zeros_(part.weight)
            nn.init.zeros_(part.bias)
        started = float(torch.tensor(1.0).sigmoid() ** 2)
        with torch.no_grad():
            self.output.weight[0, -1] = 2.0
            self.output.bias.fill_(math.log(started / (1 - started)) - 1)

    def forward(self, features: Tensor, logits: Tensor) -> Tensor:
        f = features.clamp(-MAX_FEATURE, MAX_FEATURE)
        gated = self.gate_features(f).sigmoid() * f
        u = torch.cat([gated, logits.clamp(-MAX_LOGIT, MAX_LOGIT)[:, None]], -1)
        soft: Tensor = self.output(self.gate_hidden(u).sigmoid() * u)[:, 0].sigmoid()
        return soft


def soft_mask(render_logits: Tensor, semantic_logits: Tensor | None) -> Tensor:
    """m̂ [N] in (0, 1) of the rendering gate's logits [N] and the semantic gate's, the first alone without semantics.

    Choices: the product, so that either gate alone can remove and neither overrules the other's removal; logits are
      clamped to ±10.
    """
    soft = render_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()
    return soft if semantic_logits is None else soft * semantic_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()


def hard_mask(soft: Tensor) -> Tensor:
    """Exactly 0 or 1 by THRESHOLD, with the gradient of `soft` (straight-through)."""
    return (soft > THRESHOLD).to(soft.dtype) + (soft - soft.detach())


def apply_mask(mask: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Masked scales [N, 3] and opacities [N], at render time only: what is stored never becomes log 0."""
    return scales * mask[:, None], opacities * mask
