"""SH pruning (Eq 13): nested band masks, and a penalty that spares bands that regions need."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.splats.sh import basis
from chebsplat.training.prune import MAX_LOGIT, hard_mask

BANDS = ((0, 3), (3, 8), (8, 15))  # columns of shN by band 1, 2, 3


def band_mask(logits: Tensor) -> Tensor:
    """Masks [N, 3] in {0, 1} of bands 1 to 3, nested by products, with a straight-through gradient.

    Choices: products written out; the gradient of `cumprod` asks a GPU for zeros, and waits.
    """
    first, second, third = logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid().unbind(-1)
    both = first * second
    return hard_mask(torch.stack([first, both, both * third], -1))


def masked_sh(shN: Tensor, mask: Tensor) -> Tensor:
    """shN [N, K, 3] with each band multiplied by its mask [N, 3]; band 0 is not in shN."""
    parts = [
        shN[:, a:b] * mask[:, i, None, None] for i, (a, b) in enumerate(BANDS) if a < shN.shape[1]
    ]
    return torch.cat(parts, 1) if parts else shN


def degrees(mask: Tensor) -> Tensor:
    """Highest band kept, u8 [N]."""
    return (mask > 0.5).sum(-1).to(torch.uint8)


def ragged_rows(degree: Tensor) -> list[Tensor]:
    """Rows of the Gaussians that have each band, once every one keeps only those up to its degree.

    Args: degree u8 [N], 0 to 3.
    Returns: for bands 0 to 3, i64 [N_l]: the highest degree first and otherwise in their order, so
      that each list starts the one before: band l belongs to the first N_l Gaussians, and nothing
      has to point at its rows.
    Raises: ValueError on a degree beyond 3.
    """
    if (degree > 3).any():
        raise ValueError(f"degree {int(degree.max())} is beyond 3")
    order = torch.argsort(degree.long(), descending=True, stable=True)
    return [order[: int((degree >= band).sum())] for band in range(4)]


def dense(bands: list[Tensor], n: int) -> Tensor:
    """shN [n, 15, 3] of bands 1, 2, ... [N_l, 2 l + 1, 3]; 0 where a Gaussian has none."""
    shN = bands[0].new_zeros(n, 15, 3) if bands else torch.zeros(n, 15, 3)
    for (first, last), band in zip(BANDS, bands, strict=False):
        shN[: len(band), first:last] = band
    return shN


def soft_histogram(values: Tensor, valid: Tensor, n_bins: int, low: Tensor, high: Tensor) -> Tensor:
    """Histogram whose mass is exactly 1, with gradients that stay finite (Eq 13).

    Args:
      values: [..., n]; valid bool [..., n], values elsewhere may be anything; low, high: [...]
        bounds, may coincide.
    Returns: [..., n_bins]; zero where nothing is valid.
    Choices: differences of sigmoids at the interior edges, the end bins open; slope γ = 20/Δ with
      bin width Δ ≥ 1e-6; divided by the count. Taken relative to `low`, so that bins narrower than
      its rounding stay apart.
    """
    width = ((high - low) / n_bins).clamp_min(1e-6)
    inside = torch.where(valid, values - low[..., None], 0.0) / width[..., None]
    edges = torch.arange(1, n_bins, dtype=values.dtype, device=values.device)
    below = (20 * (edges - inside[..., None])).sigmoid()
    count = valid.sum(-1, keepdim=True)
    share_below = torch.einsum("...nb,...n->...b", below, valid.to(values.dtype)) / count.clamp_min(
        1
    )
    present = (count > 0).to(values.dtype)
    return torch.diff(torch.cat([torch.zeros_like(present), share_below, present], -1), dim=-1)


def band_colors(shN: Tensor, directions: Tensor) -> Tensor:
    """Contribution of each band to the colour seen along a direction.

    Args: shN [N, K, 3]; directions [..., N, 3] unit (or [..., 1, 3] for one that all Gaussians
      share).
    Returns: [..., N, 3 bands, 3]; zero for bands that shN does not hold.
    """
    values = basis(directions, 3)[..., 1:]
    parts = [
        torch.einsum("...nk,nkc->...nc", values[..., a:b], shN[:, a:b])
        for a, b in BANDS
        if b <= shN.shape[1]
    ]
    parts += [values.new_zeros(*values.shape[:-2], len(shN), 3)] * (len(BANDS) - len(parts))
    return torch.stack(parts, -2)


def guidance_directions() -> Tensor:
    """Unit directions [10, 3]: one of each opposite pair of a dodecahedron's corners.

    No function of one band up to 3 vanishes at all of them (most of those of bands 2 and 3 do on
    the axes), and an opposite direction would only flip the sign.
    """
    g = (1 + 5**0.5) / 2
    corners: list[tuple[float, float, float]] = [(1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)]
    corners += [
        (0, g, 1 / g),
        (0, g, -1 / g),
        (1 / g, 0, g),
        (-1 / g, 0, g),
        (g, 1 / g, 0),
        (g, -1 / g, 0),
    ]
    return torch.tensor(corners) / 3**0.5


@torch.no_grad()
def region_guidance(shN: Tensor, members: Tensor, n: int, n_bins: int = 8) -> Tensor:
    """Weight in (0, 1] of each band's penalty, [n, 3], small where a region needs it (Eq 13).

    Args: shN [n, K, 3]; members i64 [M, k], -1 where padded; n_bins: odd numbers give a bin of no
      contribution, so one more is taken if it is even.
    Choices: need is the total variation t between the soft histogram of the band's colours over
      the region's Gaussians, seen from ten directions, and that without the band (all mass in the
      middle bin). The weight is 1 − t, at least 0.05, and no more than that of the bands above,
      which a band's mask takes along. A colour counts by the channel it changes most, so that
      opposite changes of two channels do not cancel. The range is that of the region's strongest
      band, but the middle bin reaches at least half a grey level (1/510) either way: pixels blend
      colours, so less is never seen. Gaussians in several regions take the mean, those in none 1. A
      guide of the penalty, not a path for gradients.
    """
    present = members >= 0
    if not present.any():
        return shN.new_ones(n, 3)
    n_bins += 1 - n_bins % 2
    used, slot = members[present].unique(return_inverse=True)
    index = torch.zeros_like(members).masked_scatter(present, slot)  # of rows of `used`
    colors = (
        band_colors(shN[used], guidance_directions()[:, None].to(shN)).movedim(-1, 0).contiguous()
    )
    highest, lowest = colors.amax(0), colors.amin(0)
    # [used, 3 bands, Q]
    changes = torch.where(highest >= -lowest, highest, lowest).permute(1, 2, 0)
    weight, times = shN.new_zeros(len(used), 3), shN.new_zeros(len(used), 1)
    for rows in torch.arange(len(members), device=shN.device).split(128):
        inside = changes[index[rows]].permute(0, 2, 1, 3).flatten(2)  # [M, 3 bands, k * Q]
        valid = present[rows][:, None, :, None].expand(-1, 3, -1, changes.shape[-1]).flatten(2)
        reach = (
            (inside.abs() * valid).amax((1, 2)).clamp_min(n_bins * 0.5 / 255)[:, None].expand(-1, 3)
        )
        histogram = soft_histogram(inside, valid, n_bins, -reach, reach)
        empty = torch.zeros_like(histogram[..., :1])
        without = soft_histogram(
            empty, torch.ones_like(empty, dtype=torch.bool), n_bins, -reach, reach
        )
        spared = (1 - 0.5 * (histogram - without).abs().sum(-1)).clamp(0.05, 1)
        spared = spared.flip(-1).cummin(-1).values.flip(-1)
        weight.index_add_(
            0,
            index[rows][present[rows]],
            spared[:, None].expand(*index[rows].shape, 3)[present[rows]],
        )
    times.index_add_(0, slot, shN.new_ones(len(slot), 1))
    return shN.new_ones(n, 3).index_copy_(0, used, weight / times)


def sh_loss(mask: Tensor, guidance: Tensor | None = None, counted: Tensor | None = None) -> Tensor:
    """Mean over Gaussians of Σ_l (2l + 1) m_l, weighted by any `guidance` [N, 3]; 0 of none.

    Args: counted bool [N]: the Gaussians that the mean is of; None: all.
    """
    cost = mask * torch.arange(3, 9, 2, dtype=mask.dtype, device=mask.device)
    return mean_of((cost if guidance is None else cost * guidance).sum(-1), counted)


def mean_of(values: Tensor, counted: Tensor | None) -> Tensor:
    """Mean of values [N], of those that are counted, bool [N] (None: of all); 0 of none."""
    if counted is None:
        return values.sum() / max(len(values), 1)
    return torch.where(counted, values, 0).sum() / counted.sum().clamp_min(1)
