"""The printed objective beside reconstruction (3DGS's) and the L1 distance of features."""

from __future__ import annotations

from torch import Tensor

from chebsplat.printed.pruning import mask_loss
from chebsplat.printed.sh_pruning import sh_loss


def auxiliary_losses(
    parts: tuple[Tensor | None, Tensor | None, Tensor | None], weights: tuple[float, float]
) -> dict[str, Tensor]:
    """L_mask, L_SH and L_reg by name; parts that are switched off are not there.

    Args: parts: the soft mask [N], delta [N, 4] and L_reg []; weights: of L_mask and L_SH, of which
      the print has none. L_reg has that of its alpha.
    """
    soft_mask, delta, knowledge = parts
    weight_mask, weight_sh = weights
    losses = {}
    if soft_mask is not None:
        losses["mask"] = weight_mask * mask_loss(soft_mask)
    if delta is not None:
        losses["sh"] = weight_sh * sh_loss(delta)
    if knowledge is not None:
        losses["knowledge"] = knowledge
    return losses
