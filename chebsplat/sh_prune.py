"""SH pruning (Eq 13): nested band masks, and a penalty that spares the bands a region's colours need."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.adapt import MAX_LOGIT, hard_mask
from chebsplat.sh import basis

BANDS = ((0, 3), (3, 8), (8, 15))  # columns of shN by band 1, 2, 3


def band_mask(logits: Tensor, threshold: float = 0.1) -> Tensor:
    """Masks [N, 3] in {0, 1} of bands 1 to 3, nested by a cumulative product, with a straight-through gradient."""
    return hard_mask(logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid().cumprod(-1), threshold)


def masked_sh(shN: Tensor, mask: Tensor) -> Tensor:
    """shN [N, K, 3] with each band multiplied by its mask [N, 3]; band 0 is not in shN and never masked."""
    parts = [shN[:, a:b] * mask[:, i, None, None] for i, (a, b) in enumerate(BANDS) if a < shN.shape[1]]
    return torch.cat(parts, 1) if parts else shN


def degrees(mask: Tensor) -> Tensor:
    """Highest band kept, u8 [N]."""
    return (mask > 0.5).sum(-1).to(torch.uint8)


def soft_histogram(values: Tensor, valid: Tensor, n_bins: int, low: Tensor, high: Tensor) -> Tensor:
    """Histogram whose mass is exactly 1, with gradients that stay finite.

    Args:
      values: [..., n]; valid bool [..., n]; low, high: [...] bounds, may coincide.
    Returns: [..., n_bins]; zero where nothing is valid.
    Choices: differences of sigmoids at the interior edges, the end bins open; slope γ = 20/Δ with bin width
      Δ ≥ 1e-6; divided by the count.
    """
    width = ((high - low) / n_bins).clamp_min(1e-6)
    edges = low[..., None] + width[..., None] * torch.arange(1, n_bins, dtype=values.dtype)
    below = (20 / width[..., None, None] * (edges[..., None, :] - values[..., None])).sigmoid()
    ends = torch.zeros_like(below[..., :1])
    mass = torch.diff(torch.cat([ends, below, ends + 1], -1), dim=-1)
    count = valid.sum(-1, keepdim=True).clamp_min(1)
    return (mass * valid[..., None]).sum(-2) / count


def band_colors(shN: Tensor, directions: Tensor) -> Tensor:
    """What each band adds to the colour seen along a direction.

    Args: shN [N, 15, 3]; directions [Q, 3] unit. Returns: [Q, N, 3 bands, 3].
    """
    values = basis(directions, 3)[:, 1:]
    parts = [torch.einsum("qk,nkc->qnc", values[:, a:b], shN[:, a:b]) for a, b in BANDS]
    return torch.stack(parts, 2)


def region_guidance(shN: Tensor, members: Tensor, n: int, n_bins: int = 8) -> Tensor:
    """Weight in (0, 1] of each band's penalty, [n, 3]; small where a region's colours need the band (Eq 13).

    Args: shN [n, 15, 3]; members i64 [M, k], -1 where padded.
    Choices: need is how far the soft histogram of the band's colours over the region, seen from the six axis
      directions, lies from all mass in the bin of no contribution: total variation t; the weight is 1 − t, at least
      0.05. The range is that of the region's strongest band, and at least 1/255. Gaussians in several regions take
      the mean, those in none 1. A guide of the penalty, not a path for gradients.
    """
    weight, times = torch.zeros(n, 3), torch.zeros(n, 1)
    if len(members) == 0 or n == 0:
        return torch.ones(n, 3)
    axes = torch.eye(3)
    colors = band_colors(shN, torch.cat([axes, -axes])).mean(-1).permute(1, 2, 0)  # [n, 3, 6]
    index, present = members.clamp_min(0), members >= 0
    inside = colors[index].permute(0, 2, 1, 3).flatten(2)  # [M, 3, k * 6]
    valid = present[:, None, :, None].expand(-1, 3, -1, 6).flatten(2)
    reach = (inside.abs() * valid).amax((1, 2)).clamp_min(0.5 / 255)[:, None].expand(-1, 3)
    empty = torch.zeros(*inside.shape[:2], 1)
    found = soft_histogram(inside, valid, n_bins + 1, -reach, reach)
    none = soft_histogram(empty, torch.ones_like(empty, dtype=torch.bool), n_bins + 1, -reach, reach)
    per_region = (1 - 0.5 * (found - none).abs().sum(-1)).clamp(0.05, 1)
    flat, rows = index[present], per_region[:, None].expand(-1, members.shape[1], -1)[present]
    weight.index_add_(0, flat, rows)
    times.index_add_(0, flat, torch.ones(len(flat), 1))
    return torch.where(times > 0, weight / times.clamp_min(1), torch.ones_like(weight))


def sh_loss(mask: Tensor, guidance: Tensor | None = None) -> Tensor:
    """Mean over Gaussians of Σ_l (2l + 1) m_l, each band weighted by `guidance` [N, 3] where given; 0 for none."""
    if len(mask) == 0:
        return mask.sum()
    cost = mask * torch.tensor([3.0, 5.0, 7.0], dtype=mask.dtype)
    return (cost if guidance is None else cost * guidance).sum(-1).mean()
