"""The gate between shape and meaning (Eq 10)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Gate(nn.Module):
    """f_final = g * f_sem + (1 - g) * f_shape, g = linear([f_shape, f_sem]) (Eq 10).

    The print has a linear map and no sigmoid, and gives g no shape: one value a channel, as its
    elementwise product asks. It starts at a half. A point in no region, such as one outside the
    frustum, keeps its semantic feature.
    """

    def __init__(self, n_channels: int):
        super().__init__()
        self.linear = nn.Linear(2 * n_channels, n_channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, 0.5)

    def values(self, shape: Tensor, semantic: Tensor) -> Tensor:
        """g [N, C] of shape and semantic features [N, C]."""
        gate: Tensor = self.linear(torch.cat([shape, semantic], -1))
        return gate

    def forward(self, shape: Tensor, semantic: Tensor, covered: Tensor) -> Tensor:
        """shape, semantic [N, C], covered [N] bool -> [N, C]."""
        gate = self.values(shape, semantic)
        fused = gate * semantic + (1 - gate) * shape
        return torch.where(covered[:, None], fused, semantic)
