"""SH pruning: nested band masks, and the penalty that closes them."""

from __future__ import annotations

import torch
from torch import Tensor

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


def sh_loss(mask: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean over Gaussians of Σ_l (2l + 1) m_l; 0 of none.

    Args: counted bool [N]: the Gaussians that the mean is of; None: all.
    """
    cost = mask * torch.arange(3, 9, 2, dtype=mask.dtype, device=mask.device)
    return mean_of(cost.sum(-1), counted)


def mean_of(values: Tensor, counted: Tensor | None) -> Tensor:
    """Mean of values [N], of those that are counted, bool [N] (None: of all); 0 of none."""
    if counted is None:
        return values.sum() / max(len(values), 1)
    return torch.where(counted, values, 0).sum() / counted.sum().clamp_min(1)
