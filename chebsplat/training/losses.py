"""Training losses: photometric (L1 and SSIM); of features, distance or cross-entropy."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from chebsplat.kernels.dispatch import is_compiled
from chebsplat.settings import TrainSection
from chebsplat.training.loss_kernels import C1, C2, TAPS, WINDOW
from chebsplat.views import TaughtLabels

TEMPERATURE = 0.1  # of the logits that cross-entropy is of


@cache
def _taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    """SSIM's window [11]; kept, so that no step copies it to a GPU."""
    return torch.as_tensor(TAPS, dtype=dtype).to(device)


def _blur(images: Tensor) -> Tensor:
    """Window blur of [H, W, C] with zero padding, by plain convolutions."""
    taps = _taps(images.dtype, images.device)
    planes = images.permute(2, 0, 1)[:, None]
    planes = torch.nn.functional.conv2d(planes, taps[None, None, :, None], padding=(WINDOW // 2, 0))
    return torch.nn.functional.conv2d(planes, taps[None, None, None, :], padding=(0, WINDOW // 2))[
        :, 0
    ].permute(1, 2, 0)


def _blur_lines(images: Tensor) -> Tensor:
    """`_blur` without a gradient, line by line: torch's convolution takes 9 times as long in
    double precision.
    """
    rows = correlate1d(images.numpy(), TAPS, 0, mode="constant")
    return torch.from_numpy(correlate1d(rows, TAPS, 1, mode="constant"))


def ssim_map(a: Tensor, b: Tensor, blur: Callable[[Tensor], Tensor] = _blur) -> Tensor:
    """Structural similarity [H, W, C] of images [H, W, C] in [0, 1]; plain torch, any float type.

    Choices: Gaussian window 11, σ 1.5, zero padding, biased variances, as 3DGS.
    """
    # at once: a GPU waits for launches, not for sums
    blurred = blur(torch.cat([a, b, a * a, b * b, a * b], -1))
    mean_a, mean_b, square_a, square_b, product = blurred.split(a.shape[-1], -1)
    var_a, var_b, covariance = square_a - mean_a**2, square_b - mean_b**2, product - mean_a * mean_b
    top = (2 * mean_a * mean_b + float(C1)) * (2 * covariance + float(C2))
    similarity: Tensor = top / ((mean_a**2 + mean_b**2 + float(C1)) * (var_a + var_b + float(C2)))
    return similarity


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM of two u8 images [H, W, 3]."""
    if a.dtype != np.uint8 or b.dtype != np.uint8 or a.shape != b.shape:
        raise ValueError(
            f"two u8 images of one shape are needed, not {a.dtype} {a.shape}, {b.dtype} {b.shape}"
        )
    first, second = (torch.from_numpy(image).double() / 255 for image in (a, b))
    return float(ssim_map(first, second, _blur_lines).mean())


class _Photometric(torch.autograd.Function):
    """The fused loss: its gradient is computed with its value."""

    @staticmethod
    def forward(
        ctx: Any, render: Tensor, target: Tensor, weight: Tensor, weight_ssim: float
    ) -> Tensor:
        from chebsplat.training.loss_kernels import photometric

        a, b, w = (t.detach().numpy() for t in (render, target, weight))
        loss, gradient = photometric(a, b, w, weight_ssim)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return render.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None


def photometric(
    render: Tensor, target: Tensor, mask: Tensor | None, weight_ssim: float, backend: str = "auto"
) -> Tensor:
    """(1 − w) L1 + w (1 − SSIM) over the pixels that count.

    Args: render [H, W, 3] of 0 and more, target in [0, 1]; mask [H, W] bool, true where a pixel
      counts, or float ≥ 0, how much it does; None: all alike; backend: of `rasterize`.
    Choices: pixels that do not count take the target's colour first, so they have no gradient, not
      even through SSIM's window. 0 where nothing counts.
    """
    if not is_compiled(render, backend):
        return photometric_reference(render, target, mask, weight_ssim)
    if mask is None:
        weight = torch.full_like(target, 1 / target.numel())
    else:
        render = torch.where(mask[..., None] > 0, render, target)
        weight = mask[..., None].to(target.dtype).expand_as(target)
        weight = weight / weight.sum().clamp_min(1e-6)
    loss: Tensor = _Photometric.apply(render, target, weight, weight_ssim)
    return loss


def photometric_reference(
    render: Tensor, target: Tensor, mask: Tensor | None, weight_ssim: float
) -> Tensor:
    """Twin and oracle of `photometric`, in plain torch, of any float type on any device."""
    counted = torch.ones_like(target[..., 0]) if mask is None else mask.to(target.dtype)
    render = torch.where(counted[..., None] > 0, render, target)
    weight = counted[..., None].expand_as(target) / (counted.sum() * target.shape[-1]).clamp_min(
        1e-6
    )
    distance = (weight * (render - target).abs()).sum()
    return (1 - weight_ssim) * distance + weight_ssim * (
        weight * (1 - ssim_map(render, target))
    ).sum()


def depth_distance(
    inverse_depth: Tensor, alpha: Tensor, truth: Tensor, mask: Tensor | None
) -> Tensor:
    """Relative distance of rendered surfaces from measured ones: mean |Σ wᵢ (d / zᵢ − 1)|.

    Args: inverse_depth [H, W] Σ wᵢ / zᵢ, alpha [H, W, 1] Σ wᵢ; truth d [H, W], nan where unknown;
      mask [H, W] or None.
    Choices: no division by alpha, so that a pixel that little covers pulls little; 0 where nothing
      is known.
    """
    has_depth = torch.isfinite(truth) & (truth > 0)
    if mask is not None:
        has_depth &= mask > 0
    d = torch.where(has_depth, truth, 1)
    distance = torch.where(has_depth, (inverse_depth * d - alpha[..., 0]).abs(), 0)
    return distance.sum() / has_depth.sum().clamp_min(1)


class _FeatureDistance(torch.autograd.Function):
    """The fused loss: its gradient is computed with its value."""

    @staticmethod
    def forward(
        ctx: Any, render: Tensor, target: Tensor, share: Tensor, by_channel: bool
    ) -> Tensor:
        from chebsplat.training.loss_kernels import feature_distance

        a, b, counts = (t.detach().contiguous().numpy() for t in (render, target, share))
        values, gradient = feature_distance(a, b, counts, by_channel)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return render.new_tensor(values.sum())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None


def cell_shares(
    mask: Tensor | None, size: tuple[int, int], like: Tensor, counted: Tensor | None = None
) -> Tensor:
    """Weight of each cell of the target, [h, w], of sum 1 (or 0): the mean of its pixels' mask [H,
    W], and 0 where `counted` [h, w] is false. Of the type and device of `like`.
    """
    if mask is None:
        share = like.new_full(size, 1 / (size[0] * size[1]))
    else:
        share = torch.nn.functional.adaptive_avg_pool2d(mask[None].to(like), size)[0]
    if counted is not None:
        share = share * counted
    return share if mask is None and counted is None else share / share.sum().clamp_min(1e-6)


def feature_distance(
    render: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    kind: str = "length",
    counted: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Mean distance to the teacher's features at the teacher's resolution.

    Args: render [H, W, C]; target [h, w, C], h ≤ H; mask [H, W] bool, true where a pixel counts, or
      float ≥ 0, how much it does. kind: `length` of the difference over √C, or `l1`, its mean
      magnitude by channel; counted [h, w] bool: cells of the target that count, None: all do;
      backend: of `rasterize`.
    Choices: the render is averaged over each cell of the target; a cell counts by the mean of its
      pixels' mask. Where views disagree about a Gaussian the shortest total length is at their
      geometric median, which lies near the most common vector; the median channel by channel, where
      L1 is least, may be near none of them.
    """
    if not is_compiled(render, backend):
        return feature_distance_reference(render, target.to(render.dtype), mask, kind, counted)
    share = cell_shares(mask, (target.shape[0], target.shape[1]), render, counted)
    loss: Tensor = _FeatureDistance.apply(render, target.to(render.dtype), share, kind == "l1")
    return loss


def feature_distance_reference(
    render: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    kind: str = "length",
    counted: Tensor | None = None,
) -> Tensor:
    """Twin and oracle of `feature_distance`, in plain torch, of any float type on any device."""
    size = (target.shape[0], target.shape[1])
    pooled = torch.nn.functional.adaptive_avg_pool2d(render.permute(2, 0, 1), size).permute(1, 2, 0)
    share = cell_shares(mask, size, render, counted)
    # what does not count may be anything
    difference = torch.where(share[..., None] != 0, pooled - target, 0.0)
    distance = (
        difference.abs().mean(-1)
        if kind == "l1"
        else difference.square().mean(-1).clamp_min(1e-30).sqrt()
    )
    return (distance * share).sum()


def semantic_loss(
    render: Tensor,
    features: Tensor,
    labels: TaughtLabels | None,
    mask: Tensor | None,
    settings: TrainSection,
    backend: str = "auto",
) -> Tensor:
    """Loss of a view's rendered features [H, W, C], by `train.feature_loss`; 0 for cells without a
    label.

    Args: features [h, w, C] and labels of the teacher; mask [H, W], true where a pixel counts, or
      None; backend: of `rasterize`.
    Raises: ValueError where cross-entropy is asked for without labels.
    """
    if settings.feature_loss == "cross-entropy":
        if labels is None:
            raise ValueError("cross-entropy needs labels with a confidence")
        return label_entropy(render, labels, mask, TEMPERATURE)
    counted = None if labels is None or labels.complete else labels.classes >= 0
    return feature_distance(
        render, features, mask, settings.feature_loss or "length", counted, backend
    )


def label_entropy(
    render: Tensor, labels: TaughtLabels, mask: Tensor | None, temperature: float
) -> Tensor:
    """Cross-entropy of labels on logits render · class codes / temperature, by confidence.

    Args: render [H, W, C], as accumulated: a pixel that little covers has logits near 0; labels of
      h × w cells, h ≤ H; mask [H, W], as of `feature_distance`.
    Returns: the mean over cells that have a label, 0 where none has one.
    Choices: the render is averaged over each cell, as in `feature_distance`. The mean is over
      cells, not over confidences: a view of which the teacher is unsure teaches less than another,
      as in Panoptic Lifting.
    """
    size = (labels.classes.shape[0], labels.classes.shape[1])
    pooled = torch.nn.functional.adaptive_avg_pool2d(render.permute(2, 0, 1), size).permute(1, 2, 0)
    logits = pooled @ labels.class_codes.to(render.dtype).T / temperature
    log_likelihood = logits.log_softmax(-1).gather(-1, labels.classes.clamp_min(0)[..., None])[
        ..., 0
    ]
    counted = labels.classes >= 0
    share = cell_shares(mask, size, render, counted) * labels.confidence.to(render.dtype)
    return -torch.where(counted & (share > 0), share * log_likelihood, 0.0).sum()
