"""Values that break printed masks (docs/method.md, section 5)."""

from __future__ import annotations

import mpmath
import torch

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.rasterize import rasterize
from chebsplat.training.prune import MAX_LOGIT, apply_mask, hard_mask, soft_mask


@case("masks of logits {size:.0e}", size=[0.0, 1.0, 17.0, 1e3, 1e30])
def masks(size: float) -> Outcome:
    """m̂ against 40 digits; hard masks are 0 or 1 and gradients finite."""
    logits = torch.tensor([-size, size], requires_grad=True)
    soft = soft_mask(logits)
    hard = hard_mask(soft)
    (slope,) = torch.autograd.grad(hard.sum(), logits)
    if not torch.isfinite(slope).all() or not ((hard == 0) | (hard == 1)).all():
        raise ValueError("a mask is neither 0 nor 1, or a gradient is not finite")
    limit = min(size, MAX_LOGIT)
    exact = [float(1 / (1 + mpmath.exp(sign * limit))) for sign in (1, -1)]
    return Outcome(relative(soft.detach(), exact), 1e-6)


@case("a mask of 0 renders as if removed")
def masked_render() -> Outcome:
    """Image of masked Gaussians against that of the rest; log-scales get a finite gradient."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(40, 3, generator=g) * torch.tensor([2.4, 1.6, 3.0]) - torch.tensor(
        [1.2, 0.8, -1.0]
    )
    quats, log_scales = (
        torch.randn(40, 4, generator=g),
        (torch.rand(40, 3, generator=g) * 0.15 + 0.02).log(),
    )
    opacities, colors = torch.rand(40, generator=g) * 0.8 + 0.1, torch.rand(40, 3, generator=g)
    K = torch.tensor([[[35.0, 0, 20], [0, 33, 14], [0, 0, 1]]])
    camera, mask = (torch.eye(4)[None], K, 40, 28), (torch.arange(40) % 2).float()
    log_scales.requires_grad_(True)
    small, faint = apply_mask(mask, log_scales.exp(), opacities)
    image = rasterize(means, quats, small, faint, colors, *camera, backend="cpu")[0]
    (slope,) = torch.autograd.grad(image.square().sum(), log_scales)
    if not torch.isfinite(slope).all():
        raise ValueError("a gradient is not finite")
    rest = (v.detach()[mask > 0] for v in (means, quats, log_scales.exp(), opacities, colors))
    return Outcome(relative(image.detach(), rasterize(*rest, *camera, backend="cpu")[0]), 0.0)
