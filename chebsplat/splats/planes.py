"""Gaussians as planes: each through its centre, across its shortest axis."""

from __future__ import annotations

import torch
from torch import Tensor

GRAZING = 0.15  # cosine of the view's angle to a plane below which its depth is that of the centre


def inverse_depths(means: Tensor, normals: Tensor, K: Tensor, nearest: float) -> Tensor:
    """q [N, 3] of each Gaussian's plane, 1 / z = q · (u, v, 1) at pixel (u, v); differentiable.

    Args: means [N, 3] and unit normals [N, 3] in the camera's frame; K [3, 3] pixels; nearest: scene units, > 0.
    Choices: a plane that is seen at a grazing angle is taken to face the camera; its depth would be without bound.
    """
    along = (normals * means).sum(-1)
    grazing = along.abs() < GRAZING * means.norm(dim=-1).clamp_min(nearest)
    planes = normals @ torch.linalg.inv(K) / torch.where(grazing, 1, along)[:, None]
    facing = torch.nn.functional.pad(1 / means[:, 2:].clamp_min(nearest), (2, 0))
    return torch.where(grazing[:, None], facing, planes)


def at_pixels(planes: Tensor) -> Tensor:
    """q · (u, v, 1) [H, W] at the pixels' centres, of an image of planes q [H, W, 3]."""
    height, width = planes.shape[:2]
    u, v = (torch.arange(n, dtype=planes.dtype, device=planes.device) + 0.5 for n in (width, height))
    return planes[..., 0] * u + planes[..., 1] * v[:, None] + planes[..., 2]
