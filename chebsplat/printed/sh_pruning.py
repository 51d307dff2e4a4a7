"""Spherical-harmonics pruning by meaning and by the colours of a region (Eq 13)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

DEGREES = (0, 1, 2, 3)
STARTS_AT = 1.0  # logit of every mask: open


def soft_histogram(
    values: Tensor, present: Tensor, low: Tensor, high: Tensor, n_bins: int, softness: float
) -> Tensor:
    """H[b] = sum_x s(gamma (x - left_b)) - s(gamma (x - right_b)), [..., n_bins] (Eq 13).

    Args: values [..., n], those not `present` count nothing; low, high [...]: m and M of [m, M].
    A range of no width has bins of no width: its histogram is zero, as printed.
    """
    width = (high - low) / n_bins
    edges = low[..., None] + width[..., None] * torch.arange(n_bins + 1).to(values)
    above = (softness * (values[..., None] - edges[..., None, :])).sigmoid()
    between = above[..., :-1] - above[..., 1:]
    return torch.where(present[..., None], between, 0.0).sum(-2)


def region_histograms(bands: list[Tensor], members: Tensor, n_bins: int, softness: float) -> Tensor:
    """H of degrees 0 to 3 in regions of members i64 [M, n], -1 where padded: [M, 4, n_bins].

    Args: bands: SH coefficients [N, 2 l + 1, 3] of each degree.
    Choices: the print does not say what a degree's colour values are: its coefficients, which
      belong to no view, so that a mask is one of the scene. [m, M] is what occurs in the region.
    """
    present, rows = members >= 0, members.clamp_min(0)
    histograms = []
    for band in bands:
        values = band.index_select(0, rows.flatten()).reshape(*rows.shape, *band.shape[1:])
        is_there = present[:, :, None, None].expand_as(values).flatten(1)
        values = values.flatten(1)
        low = values.masked_fill(~is_there, torch.inf).amin(-1).nan_to_num(posinf=0.0)
        high = values.masked_fill(~is_there, -torch.inf).amax(-1).nan_to_num(neginf=0.0)
        histograms.append(soft_histogram(values, is_there, low, high, n_bins, softness))
    return torch.stack(histograms, 1)


class BandMasks(nn.Module):
    """delta^(l) = sigmoid(linear_l([f, psi^(l), eta^(l)])), eta^(l) = MLP_l(H^(l)), l = 0 ... 3.

    Each degree has its own map and its own mask, not nested in those below. A Gaussian of no region
    has eta = 0. The linear maps start on psi alone, so that every band starts open.
    """

    def __init__(self, n_channels: int, n_bins: int = 8, width: int = 8):
        super().__init__()
        self.n_bins = n_bins
        self.embed = nn.ModuleList(
            nn.Sequential(nn.Linear(n_bins, width), nn.ReLU(), nn.Linear(width, width))
            for _ in DEGREES
        )
        maps = [nn.Linear(n_channels + 1 + width, 1) for _ in DEGREES]
        with torch.no_grad():
            for linear in maps:
                linear.weight.zero_()
                linear.weight[0, n_channels] = 1.0
                linear.bias.fill_(STARTS_AT)
        self.output = nn.ModuleList(maps)

    def forward(
        self, features: Tensor, logits: Tensor, histograms: Tensor, region: Tensor
    ) -> Tensor:
        """f [N, C], psi [N, 4], histograms [M, 4, B], region i64 [N] or -1 -> delta [N, 4]."""
        columns = []
        for degree in DEGREES:
            of_regions = self.embed[degree](histograms[:, degree])
            none = of_regions.new_zeros(1, of_regions.shape[1])
            eta = torch.cat([none, of_regions]).index_select(0, region + 1)
            v = torch.cat([features, logits[:, degree : degree + 1], eta], -1)
            columns.append(self.output[degree](v)[:, 0].sigmoid())
        return torch.stack(columns, -1)


def sh_loss(delta: Tensor) -> Tensor:
    """L_SH = 1/N sum_i sum_l (2 l + 1) delta_i^(l) of delta [N, 4]; 0 without Gaussians."""
    costs = delta.new_tensor([2 * degree + 1 for degree in DEGREES])
    return (delta * costs).sum() / max(len(delta), 1)
