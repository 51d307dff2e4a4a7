"""Perspective projection of 3D Gaussians to screen-space ellipses (EWA)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from chebsplat.splats.rotations import rotation_matrices

EXTENT = 3.33  # in σ: there even a Gaussian of opacity 1 has fallen to 1/255, √(2 ln 255)
LEAST_KEPT = 0.005  # of an opacity that is compensated: 3DGS's and gsplat's floor
# of a projected variance, pixels²: more is culled, so that float32 can hold what is made of it
LARGEST = 1e30


class Projected(NamedTuple):
    """Gaussians of one view. Rows with `visible` false hold zeros."""

    means2d: Tensor  # [N, 2] pixels; pixel centres are at half integers
    covariances: Tensor  # [N, 3] xx, xy, yy of the 2D covariance, ε included, pixels²
    conics: Tensor  # [N, 3] upper triangle of its inverse, pixels⁻²
    # [N, 3] p, q, r of W = [[p, q], [0, r]], WᵀW half the conic: at an offset d, α ∝ exp(−|W d|²)
    whitening: Tensor
    # [N] √(det Σ / det(Σ + ε I)), what ε adds to the ellipse's area; at least LEAST_KEPT
    compensations: Tensor
    depths: Tensor  # [N] camera z
    radii: Tensor  # [N] int, extent of the opacity-independent ellipse of 3.33 σ in pixels
    visible: Tensor  # [N] bool


def is_antialiased(rasterize_mode: str) -> bool:
    """Raises: ValueError unless the mode is `classic` or `antialiased`."""
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode {rasterize_mode!r} is neither classic nor antialiased")
    return rasterize_mode == "antialiased"


def compensated(opacities: Tensor, compensations: Tensor) -> Tensor:
    """Opacities [N] times compensations [N]; one that is not finite becomes 0, without gradient."""
    return torch.where(torch.isfinite(opacities), opacities, 0) * compensations


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    bounds: tuple[float, float],
    eps2d: float,
) -> Projected:
    """Project Gaussians into one camera.

    Args: see `rasterize`; `viewmat` [4, 4], `K` [3, 3]; size: width and height; bounds: near and
      far plane.
    Choices: culled by `not (near < z < far)`, which rejects NaN too; the view ray's slope is
      clamped to 1.3 times the field of view in the Jacobian, as gsplat does; a zero quaternion or a
      non-finite result is culled, never repaired.
    """
    (width, height), (near_plane, far_plane) = size, bounds
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    usable = (camera[:, 2] > near_plane) & (camera[:, 2] < far_plane)
    usable &= (
        torch.isfinite(camera).all(-1)
        & torch.isfinite(scales).all(-1)
        & torch.isfinite(quats).all(-1)
    )
    usable &= quats.abs().amax(-1) > 1e-12

    # Compute on harmless stand-ins where unusable: a masked-out NaN would still poison the
    # gradient.
    one = torch.tensor([0.0, 0.0, 1.0], dtype=means.dtype, device=means.device)
    camera = torch.where(usable[:, None], camera, one)
    quats = torch.where(usable[:, None], quats, torch.ones_like(quats))
    scales = torch.where(usable[:, None], scales, torch.ones_like(scales))

    x, y, z = camera.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    slack_x, slack_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    tx = z * torch.minimum(torch.maximum(x / z, -(cx / fx + slack_x)), (width - cx) / fx + slack_x)
    ty = z * torch.minimum(torch.maximum(y / z, -(cy / fy + slack_y)), (height - cy) / fy + slack_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * tx / z**2], -1),
            torch.stack([zero, fy / z, -fy * ty / z**2], -1),
        ],
        -2,
    )
    factor = jacobian @ viewmat[:3, :3] @ rotation_matrices(quats) * scales[:, None, :]  # [N, 2, 3]
    a, b, c, _, determinant = (t.detach() for t in _ellipses(factor, eps2d))
    largest = 0.5 * (a + c) + eps2d + (0.25 * (a - c) ** 2 + b * b).sqrt()
    visible = usable & torch.isfinite(determinant) & (determinant > 0) & (largest < LARGEST)
    factor = torch.where(visible[:, None, None], factor, torch.eye(2, 3).to(factor))
    a, b, c, cross, determinant = _ellipses(factor, eps2d)
    covariances = torch.stack([a + eps2d, b, c + eps2d], -1)
    conics = torch.stack([c + eps2d, -b, a + eps2d], -1) / determinant[:, None]
    # from the covariance, not from the conic, whose own determinant would cancel
    p, r = (0.5 * (c + eps2d) / determinant).sqrt(), (0.5 / (c + eps2d)).sqrt()
    whitening = torch.stack([p, -p * b / (c + eps2d), r], -1)
    compensations = (torch.linalg.vector_norm(cross, dim=-1) / determinant.sqrt()).clamp_min(
        LEAST_KEPT
    )
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)

    reach = (EXTENT * largest.sqrt()).ceil().clamp_max(2**30)
    u, v = means2d.detach().unbind(-1)
    visible = (
        visible & (u + reach > 0) & (u - reach < width) & (v + reach > 0) & (v - reach < height)
    )
    rows = [
        torch.where(visible[:, None], t, torch.zeros_like(t))
        for t in (means2d, covariances, conics, whitening)
    ]
    numbers = [torch.where(visible, t, torch.zeros_like(t)) for t in (compensations, z, reach)]
    return Projected(
        rows[0], rows[1], rows[2], rows[3], numbers[0], numbers[1], numbers[2].int(), visible
    )


def _ellipses(factor: Tensor, eps2d: float) -> tuple[Tensor, ...]:
    """xx, xy, yy of F Fᵀ, the cross product [N, 3] of F's rows, det(F Fᵀ + ε I), of F [N, 2, 3]."""
    p1, p2 = factor.unbind(-2)
    a, b, c = (p1 * p1).sum(-1), (p1 * p2).sum(-1), (p2 * p2).sum(-1)
    # Cauchy-Binet: a sum of non-negative terms, where (a+ε)(c+ε) − b² cancels for needles.
    cross = torch.linalg.cross(p1, p2)
    return a, b, c, cross, eps2d**2 + eps2d * (a + c) + (cross * cross).sum(-1)
