"""The training objective: reconstruction, semantics, pruning of Gaussians and of SH, knowledge.

The print gives no weights and takes the reconstruction loss from 3DGS, where the trainer has it.
"""

from __future__ import annotations

from torch import Tensor

from chebsplat.printed.pruning import mask_loss
from chebsplat.printed.sh_pruning import sh_loss

WEIGHT_MASK = 1e-2  # of L_mask
WEIGHT_SH = 4e-5  # of L_SH
WEIGHT_KNOWLEDGE = 1.0  # of L_reg


def semantic_loss(rendered: Tensor, taught: Tensor) -> Tensor:
    """L1 distance of rendered and teacher's features [H, W, C]."""
    return (rendered - taught).abs().mean()


def auxiliary_losses(soft_mask: Tensor | None, delta: Tensor | None, knowledge: Tensor | None) -> dict[str, Tensor]:
    """L_mask, L_SH and L_reg by name, weighted; those whose part is switched off are not there."""
    losses = {}
    if soft_mask is not None:
        losses["mask"] = WEIGHT_MASK * mask_loss(soft_mask)
    if delta is not None:
        losses["sh"] = WEIGHT_SH * sh_loss(delta)
    if knowledge is not None:
        losses["knowledge"] = WEIGHT_KNOWLEDGE * knowledge
    return losses
