"""Training crops: another place, scale, turn and side of a view, in other colours, blurred and noisy."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from chebsplat.teachers.network import STRIDE


def crops(images: Tensor, labels: Tensor, height: int, width: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Crops of u8 images [B, H, W, 3], and labels at the network's resolution.

    Returns: images [B, 3, height, width] in [0, 1]; labels i64 [B, height/2, width/2] of i8 [B, H, W].
    Choices: labels are those of the nearest pixel to the centre of a cell; outside the view they are -1. Between
      0.74 and 1.35 times the scale, up to 5° of turn, one in two mirrored.
    """
    n, full_height, full_width = labels.shape
    scale = torch.exp(_uniform(n, generator, -0.3, 0.3))  # source pixels by pixel of the crop
    aspect = torch.exp(_uniform(n, generator, -0.12, 0.12))
    turn = torch.deg2rad(_uniform(n, generator, -5, 5))
    mirror = torch.where(_uniform(n, generator) < 0.5, -1.0, 1.0)
    half_x, half_y = scale * aspect * width / full_width, scale / aspect * height / full_height
    x = (1 - half_x).clip(0.15) * _uniform(n, generator, -1, 1)
    y = (1 - half_y).clip(0.15) * _uniform(n, generator, -1, 1)
    c, s, ratio = turn.cos(), turn.sin(), full_height / full_width
    rows = [torch.stack([mirror * half_x * c, -half_y * s * ratio, x], 1),
            torch.stack([mirror * half_x * s / ratio, half_y * c, y], 1)]  # fmt: skip
    theta = torch.stack(rows, 1)
    grid = F.affine_grid(theta, [n, 1, height, width], align_corners=False)
    coarse = F.affine_grid(theta, [n, 1, height // STRIDE, width // STRIDE], align_corners=False)
    source = images.permute(0, 3, 1, 2).float() / 255
    image = F.grid_sample(source, grid, padding_mode="reflection", align_corners=False)
    label = F.grid_sample(labels[:, None].float() + 1, coarse, mode="nearest", align_corners=False)
    return image, label[:, 0].long() - 1


def recolored(images: Tensor, generator: torch.Generator) -> Tensor:
    """Images [B, 3, H, W] in [0, 1] under other light and by another camera; four in ten are left as they are."""
    n, untouched = len(images), images

    def chosen(share: float) -> Tensor:
        return (_uniform(n, generator) < share)[:, None, None, None]

    def number(low: float, high: float) -> Tensor:
        return _uniform(n, generator, low, high)[:, None, None, None]

    mix = torch.eye(3) + 0.1 * torch.randn(n, 3, 3, generator=generator)
    order = torch.stack([torch.randperm(3, generator=generator) for _ in range(n)])
    mix = torch.where(chosen(0.08)[:, 0], torch.eye(3)[order], mix)
    mix = torch.where(chosen(0.05)[:, 0], torch.full((3, 3), 1 / 3), mix)
    images = torch.where(chosen(0.8), torch.einsum("bij,bjhw->bihw", mix, images), images)
    images = images * torch.exp(0.25 * torch.randn(n, 1, 1, 1, generator=generator))
    images = images * torch.exp(0.1 * torch.randn(n, 3, 1, 1, generator=generator)) + number(-0.08, 0.08)
    images = images.clip(1e-4, 1) ** torch.exp(0.3 * torch.randn(n, 1, 1, 1, generator=generator))
    smooth = F.avg_pool2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), 3, 1)
    images = torch.where(chosen(0.5), images + number(-0.6, 1) * (smooth - images), images)
    sigma = torch.where(chosen(0.5), number(0, 0.05), torch.zeros(()))
    noisy = (images + sigma * torch.randn(images.shape, generator=generator)).clip(0, 1)
    return torch.where(chosen(0.4), untouched, noisy)


def _uniform(n: int, generator: torch.Generator, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(n, generator=generator)
