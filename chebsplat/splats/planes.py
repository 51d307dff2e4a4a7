"""Gaussians as planes: each through its centre, across its shortest axis."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

GRAZING = 0.15  # cosine of the view's angle to a plane below which it is tilted towards the camera


def inverse_depths(means: Tensor, normals: Tensor, K: Tensor, nearest: float) -> Tensor:
    """q [N, 3] of each Gaussian's plane, 1 / z = q · (u, v, 1) at pixel (u, v).

    Args: means [N, 3] and unit normals [N, 3] in the camera's frame; K [3, 3] pixels; nearest:
      scene units, > 0.
    Choices: a plane that is seen at a grazing angle, whose depth would be without bound, is mixed
      with the one through its centre that faces the camera, by the square of the angle's cosine:
      nothing jumps, neither where the mixing begins nor where a plane turns its other side.
    """
    along, limit = _along(means, normals, nearest)
    inverse = along / torch.maximum(along.abs(), limit).square()
    facing = torch.nn.functional.pad(1 / means[:, 2:].clamp_min(nearest), (2, 0))
    return normals @ inverse_of(K) * inverse[:, None] + facing * (1 - along * inverse)[:, None]


def inverse_of(K: Tensor) -> Tensor:
    """K⁻¹ [3, 3] of K, whose last row is (0, 0, 1), without `inv`'s check: a GPU waits for that."""
    (fx, skew, cx), (_, fy, cy), (_, _, one) = K
    zero = torch.zeros_like(one)
    rows = [
        one / fx,
        -skew / (fx * fy),
        (skew * cy - cx * fy) / (fx * fy),
        zero,
        one / fy,
        -cy / fy,
        zero,
        zero,
        one,
    ]
    return torch.stack(rows).reshape(3, 3)


def _along(means: Tensor, normals: Tensor, nearest: float) -> tuple[Tensor, Tensor]:
    """Distance [N] of each plane from the camera, signed, and the least [N] that is not grazing."""
    return (normals * means).sum(-1), GRAZING * means.norm(dim=-1).clamp_min(nearest)


class _Planes(torch.autograd.Function):
    """`planes_in_view` with a gradient by hand, for a fifth of the time of autograd's."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        viewmat: Tensor,
        K: Tensor,
        nearest: float,
    ) -> Tensor:
        largest = quats.abs().amax(-1, keepdim=True).clamp_min(1e-30)
        lengths = (quats / largest).norm(dim=-1, keepdim=True).clamp_min(1e-12)
        w, r = (quats / largest / lengths).split([1, 3], -1)
        axis, turn = (
            torch.eye(3, dtype=means.dtype, device=means.device)[scales.argmin(1)],
            viewmat[:3, :3].T,
        )
        normals = (2 * w * w - 1) * axis + 2 * (
            (r * axis).sum(-1, True) * r + w * torch.linalg.cross(r, axis)
        )
        where, across = means @ turn + viewmat[:3, 3], normals @ turn
        ctx.save_for_backward(where, across, normals, w, r, largest * lengths, viewmat, K)
        ctx.nearest = nearest
        return inverse_depths(where, across, K, nearest)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        where, across, normals, w, r, lengths, viewmat, K = ctx.saved_tensors
        along, limit = _along(where, across, ctx.nearest)
        grazing, square = along.abs() < limit, torch.maximum(along.abs(), limit).square()
        inverse, z, norms = along / square, where[:, 2:], where.norm(dim=-1)
        slope = grad @ inverse_of(K).T
        pull, face = (slope * across).sum(-1), grad[:, 2] / z[:, 0].clamp_min(ctx.nearest)
        by_along = torch.where(grazing, pull / square - 2 * face * inverse, -pull / square)
        # of the limit, as the distance grows
        by_mean = -2 * GRAZING**2 * inverse * (pull - face * along) / square
        by_mean = torch.where(grazing & (norms > ctx.nearest), by_mean, 0)
        facing = torch.where(grazing, 1 - along * inverse, 0)[:, None] * torch.nn.functional.pad(
            torch.where(z > ctx.nearest, -grad[:, 2:] / z.square(), 0), (2, 0)
        )
        to_where = by_along[:, None] * across + by_mean[:, None] * where + facing
        to_normals = (inverse[:, None] * slope + by_along[:, None] * where) @ viewmat[:3, :3]
        torque = torch.linalg.cross(normals, to_normals)  # of a small turn in the world
        real, imaginary = -(torque * r).sum(-1, True), w * torque + torch.linalg.cross(torque, r)
        return (
            to_where @ viewmat[:3, :3],
            2 * torch.cat([real, imaginary], -1) / lengths,
            None,
            None,
            None,
            None,
        )


def planes_in_view(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, nearest: float
) -> Tensor:
    """q [N, 3] of `inverse_depths`, of planes across Gaussians' shortest axes; differentiable by
    means and quaternions.

    Args: means [N, 3], quats [N, 4], scales [N, 3] in the world; viewmat [4, 4] world to camera; K,
      nearest: as there.
    """
    planes: Tensor = _Planes.apply(means, quats, scales, viewmat, K, nearest)
    return planes


def at_pixels(planes: Tensor) -> Tensor:
    """q · (u, v, 1) [H, W] at the pixels' centres, of an image of planes q [H, W, 3]."""
    height, width = planes.shape[:2]
    u, v = (
        torch.arange(n, dtype=planes.dtype, device=planes.device) + 0.5 for n in (width, height)
    )
    return planes[..., 0] * u + planes[..., 1] * v[:, None] + planes[..., 2]
