"""The paper's SH pruning (Eq 13): a network that closes bands by semantics and by the colours of a region."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from chebsplat.splats.sh import basis
from chebsplat.training.prune import MAX_FEATURE, MAX_LOGIT, hard_mask
from chebsplat.training.sh_prune import soft_histogram

N_BINS = 8  # of the histogram of a region's colours (Eq 13)
BANDS = ((0, 1), (1, 4), (4, 9), (9, 16))  # coefficients of bands 0 to 3
WEIGHTS = (1.0, 3.0, 5.0, 7.0)  # 2 l + 1


def whole(bands: list[Tensor]) -> Tensor:
    """Coefficients [N, 16, 3] of bands [N, 2 l + 1, 3] from 0 on, zero for those that are not given."""
    given = torch.cat(bands, 1)
    return torch.cat([given, given.new_zeros(len(given), 16 - given.shape[1], 3)], 1)


def region_histograms(coefficients: Tensor, directions: Tensor, members: Tensor, n_bins: int) -> Tensor:
    """H(R) of Eq 13: histogram [M, 4, n_bins] of what each SH band adds to the colours of a region's Gaussians.

    Args:
      coefficients: [N, 16, 3] of bands 0 to 3; the histogram's gradient reaches them.
      directions:   [N, 3] unit, along which each Gaussian is seen.
      members:      i64 [M, n] Gaussians, -1 where padded.
    Returns: [M, 4, n_bins]; each band's bins sum to 1, or to 0 in a region without members.
    Choices: the three colour channels count alike. Bins reach from the region's smallest to its largest value of the
      band, and are 1e-6 wide at least; `soft_histogram` says what the printed histogram would do.
    """
    present, index = members >= 0, members.clamp_min(0)
    values, inside = basis(directions[index], 3), coefficients[index]
    parts = [torch.einsum("mnk,mnkc->mnc", values[..., a:b], inside[..., a:b, :]) for a, b in BANDS]
    colors = torch.stack(parts, 1).flatten(2)  # [M, 4, n * 3]
    valid = present[:, None, :, None].expand(-1, 4, -1, 3).flatten(2)
    low = colors.masked_fill(~valid, torch.inf).amin(-1).nan_to_num(posinf=0.0)
    high = colors.masked_fill(~valid, -torch.inf).amax(-1).nan_to_num(neginf=0.0)
    return soft_histogram(colors, valid, n_bins, low, high)


class BandMaskNetwork(nn.Module):
    """δ [N, 4] in (0, 1) of bands 0 to 3, by weights that all Gaussians share (Eq 13).

        η_l = MLP_l(H_l(R)),    v = [f, ψ, η],    δ = σ(W v + b)

    f [N, C] are the fused features, ψ [N, 3] the Gaussian's own logits of bands 1 to 3, and R its nearest region.
    Without guidance v is ψ alone.

    Choices: W starts on ψ alone, so that δ starts as the logits alone would have it, and band 0 open. Bands 1 to 3 are
      nested by a cumulative product, as the ragged arrays need it. ψ is clamped to ±10, features to ±1000.
    """

    def __init__(self, n_channels: int, n_bins: int = N_BINS, width: int = 8, *, guided: bool = True):
        super().__init__()
        self.guided, self.n_bins, self.n_channels = guided, n_bins, n_channels if guided else 0
        n_channels = self.n_channels
        if guided:
            self.embed = nn.ModuleList(
                nn.Sequential(nn.Linear(n_bins, width), nn.ReLU(), nn.Linear(width, width)) for _ in BANDS
            )
        self.output = nn.Linear(n_channels + 3 + (4 * width if guided else 0), 4)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)
        with torch.no_grad():
            for band in range(3):
                self.output.weight[1 + band, n_channels + band] = 1.0
            self.output.bias[0] = 3.0

    def forward(self, logits: Tensor, features: Tensor | None, histograms: Tensor | None, nearest: Tensor) -> Tensor:
        """logits ψ [V, 3]; features [V, C], None where C = 0; histograms [M, 4, n_bins], None without guidance; nearest
        i64 [V] of their rows, -1 for none.
        """
        v = logits.clamp(-MAX_LOGIT, MAX_LOGIT)
        if self.guided:
            if histograms is None or (features is None and self.n_channels):
                raise ValueError("guided band masks need features and histograms")
            eta = torch.cat([part(histograms[:, band]) for band, part in enumerate(self.embed)], -1)
            eta = torch.where(nearest[:, None] >= 0, eta[nearest.clamp_min(0)], 0.0)
            f = [features.clamp(-MAX_FEATURE, MAX_FEATURE)] if features is not None and self.n_channels else []
            v = torch.cat([*f, v, eta], -1)
        delta: Tensor = self.output(v).sigmoid()
        return delta


def nested(delta: Tensor) -> Tensor:
    """Masks [V, 4] in {0, 1} of δ [V, 4], with a straight-through gradient; bands 1 to 3 by a cumulative product."""
    return hard_mask(torch.cat([delta[:, :1], delta[:, 1:].cumprod(-1)], -1))


def sh_loss(delta: Tensor) -> Tensor:
    """L_SH: mean over Gaussians of Σ_l (2 l + 1) δ_l, l = 0 ... 3; 0 for none."""
    return (delta * delta.new_tensor(WEIGHTS)).sum(-1).mean() if len(delta) else delta.sum()
