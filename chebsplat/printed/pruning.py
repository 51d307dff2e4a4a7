"""Semantic-aware pruning: two gates, a soft mask, a binary one with a straight-through gradient."""

from __future__ import annotations

import torch
from torch import Tensor, nn

STARTS_AT = 1.0  # added to what phi gives the soft mask at the start: open, alike for all


class PruningGate(nn.Module):
    """Soft mask of fused features f and pruning parameters phi.

    f' = sigmoid(W1 f) * f;  u = [f', phi];  h = sigmoid(W2 u) * u;  m = sigmoid(w . h)

    The second gating network is in words only; it has the form of the first. The last map starts on
    phi alone, so that every Gaussian starts open.
    """

    def __init__(self, n_channels: int):
        super().__init__()
        self.gate_features = nn.Linear(n_channels, n_channels)
        self.gate_hidden = nn.Linear(n_channels + 1, n_channels + 1)
        self.output = nn.Linear(n_channels + 1, 1)
        with torch.no_grad():
            self.output.weight.zero_()
            self.output.weight[0, -1] = 1.0
            self.output.bias.fill_(STARTS_AT)

    def forward(self, features: Tensor, logits: Tensor) -> Tensor:
        """f [N, C], phi [N] -> m [N] in (0, 1)."""
        gated = self.gate_features(features).sigmoid() * features
        u = torch.cat([gated, logits[:, None]], -1)
        hidden = self.gate_hidden(u).sigmoid() * u
        soft: Tensor = self.output(hidden)[:, 0].sigmoid()
        return soft


def binarize(soft: Tensor, threshold: float) -> Tensor:
    """1 above the threshold, else 0, with the gradient of `soft` (straight-through)."""
    return (soft > threshold).to(soft.dtype) + (soft - soft.detach())


def apply_mask(mask: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """m s [N, 3] and m alpha [N]."""
    return scales * mask[:, None], opacities * mask


def mask_loss(soft: Tensor) -> Tensor:
    """L_mask = 1/N sum_i m_i over all N Gaussians; 0 without any."""
    return soft.sum() / max(len(soft), 1)
