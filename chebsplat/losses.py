"""Training losses: photometric (L1 and SSIM) and feature distance."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

C1, C2 = 0.01**2, 0.03**2


def _blur(images: Tensor) -> Tensor:
    """Separable window blur of [H, W, C] by numba in float32; plain torch for other types."""
    from chebsplat import blur

    if images.dtype == torch.float32:
        return torch.from_numpy(blur.blur(images.detach().contiguous().numpy()))
    taps = torch.as_tensor(blur.TAPS, dtype=images.dtype)
    planes = images.permute(2, 0, 1)[:, None]
    half = blur.WINDOW // 2
    planes = torch.nn.functional.conv2d(planes, taps[None, None, :, None], padding=(half, 0))
    return torch.nn.functional.conv2d(planes, taps[None, None, None, :], padding=(0, half))[:, 0].permute(1, 2, 0)


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity [H, W, C] of images [H, W, C] in [0, 1]; the oracle, differentiable in float64.

    Choices: Gaussian window 11, σ 1.5, zero padding, biased variances, as 3DGS.
    """
    mean_a, mean_b = _blur(a), _blur(b)
    var_a, var_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    return top / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM of two u8 images [H, W, 3]."""
    if a.dtype != np.uint8 or b.dtype != np.uint8 or a.shape != b.shape:
        raise ValueError(f"two u8 images of one shape are needed, not {a.dtype} {a.shape}, {b.dtype} {b.shape}")
    return float(ssim_map(torch.from_numpy(a).double() / 255, torch.from_numpy(b).double() / 255).mean())


class _Ssim(torch.autograd.Function):
    """Mean SSIM over the valid pixels, value and gradient together: 8 blurs in all."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, weight: Tensor) -> Tensor:  # type: ignore[override]
        blurred = _blur(torch.cat([a, b, a * a, b * b, a * b], -1))
        mean_a, mean_b, aa, bb, ab = blurred.split(3, -1)
        var, cov = aa - mean_a**2 + bb - mean_b**2, ab - mean_a * mean_b
        top_1, top_2 = 2 * mean_a * mean_b + C1, 2 * cov + C2
        low_1, low_2 = mean_a**2 + mean_b**2 + C1, var + C2
        values = top_1 * top_2 / (low_1 * low_2)
        by_cov = 2 * top_1 / (low_1 * low_2) * weight
        by_var = -values / low_2 * weight
        by_mean = (2 * mean_b * top_2 / (low_1 * low_2) - 2 * mean_a * values / low_1) * weight
        by_mean = by_mean - 2 * mean_a * by_var - mean_b * by_cov
        back_mean, back_var, back_cov = _blur(torch.cat([by_mean, by_var, by_cov], -1)).split(3, -1)
        ctx.save_for_backward(back_mean + 2 * a * back_var + b * back_cov)
        return (values * weight).sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor):  # type: ignore[no-untyped-def, override]
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None


def photometric(render: Tensor, target: Tensor, mask: Tensor | None, weight_ssim: float) -> Tensor:
    """(1 − w) L1 + w (1 − SSIM) over the pixels that count.

    Args: render, target [H, W, 3] in [0, 1]; mask [H, W] bool, true where a pixel counts; None: all.
    Choices: masked pixels take the target's colour first, so they have no gradient, not even through SSIM's window.
      0 where nothing counts.
    """
    if mask is not None:
        render = torch.where(mask[..., None], render, target)
        weight = mask[..., None].to(render.dtype).expand_as(render)
        weight = weight / weight.sum().clamp_min(1)
    else:
        weight = torch.full_like(render, 1 / render.numel())
    l1 = ((render - target).abs() * weight).sum()
    if weight_ssim == 0:
        return l1
    return (1 - weight_ssim) * l1 + weight_ssim * (weight.sum() - _Ssim.apply(render, target, weight))


def feature_l1(render: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean |difference| at the teacher's resolution.

    Args: render [H, W, C]; target [h, w, C], h ≤ H; mask [H, W] bool, true where a pixel counts.
    Choices: the render is averaged over each cell of the target; a cell counts by the share of its pixels that do.
    """
    size = (target.shape[0], target.shape[1])
    pooled = torch.nn.functional.adaptive_avg_pool2d(render.permute(2, 0, 1), size).permute(1, 2, 0)
    difference = (pooled - target.to(render.dtype)).abs().mean(-1)
    if mask is None:
        return difference.mean()
    share = torch.nn.functional.adaptive_avg_pool2d(mask[None].to(render.dtype), size)[0]
    return (difference * share).sum() / share.sum().clamp_min(1e-6)
