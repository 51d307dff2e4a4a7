"""The oracle: plain torch, any float type, exact compositing order; slow, and meant to be read."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from chebsplat.rasterize.projection import project

ALPHA_MIN = 1 / 255  # fainter contributions are skipped
T_MIN = 1e-4  # compositing stops before transmittance falls to this


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    max_alpha: float = 0.99,
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians front to back into C views, D channels at once; differentiable by autograd.

    Args:
      means:       [N, 3] centres, scene units.
      quats:       [N, 4] wxyz, any length.
      scales:      [N, 3] standard deviations, scene units, > 0.
      opacities:   [N] in (0, 1).
      colors:      [N, D] or [C, N, D], already evaluated; any number of channels.
      viewmats:    [C, 4, 4] world to camera, OpenCV axes.
      Ks:          [C, 3, 3] pixels.
      backgrounds: [C, D]; black if None.
      max_alpha:   ceiling of one Gaussian's alpha; its gradient above is zero.
    Returns: renders [C, H, W, D], alphas [C, H, W, 1], and meta: `means2d` [C, N, 2] (retains its gradient),
      `conics` [C, N, 3], `depths` [C, N], `radii` [C, N].
    Choices: gsplat's constants, so that every backend renders a scene alike.
    """
    dtype, device = means.dtype, means.device
    y, x = torch.meshgrid(
        torch.arange(height, dtype=dtype, device=device) + 0.5,
        torch.arange(width, dtype=dtype, device=device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([x, y], -1).reshape(-1, 2)
    views = [project(means, quats, scales, v, k, width, height, near_plane, far_plane, eps2d)
             for v, k in zip(viewmats, Ks, strict=True)]  # fmt: skip
    means2d = torch.stack([view.means2d for view in views])
    if means2d.requires_grad:
        means2d.retain_grad()
    renders, alphas = [], []
    for c, view in enumerate(views):
        channels = colors if colors.ndim == 2 else colors[c]
        shown = view.visible & (opacities >= ALPHA_MIN) & torch.isfinite(opacities) & torch.isfinite(channels).all(-1)
        order = torch.argsort(view.depths[shown], stable=True)
        index = shown.nonzero()[:, 0][order]
        weights = _weights(pixels, means2d[c, index], view.conics[index], opacities[index], max_alpha)
        render = weights @ channels[index]
        alpha = weights.sum(-1, keepdim=True)
        if backgrounds is not None:
            render = render + (1 - alpha) * backgrounds[c]
        renders.append(render.reshape(height, width, -1))
        alphas.append(alpha.reshape(height, width, 1))
    meta = {
        "means2d": means2d,
        "conics": torch.stack([view.conics for view in views]),
        "depths": torch.stack([view.depths for view in views]),
        "radii": torch.stack([view.radii for view in views]),
    }
    return torch.stack(renders), torch.stack(alphas), meta


def _weights(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, max_alpha: float) -> Tensor:
    """Compositing weights [P, M] of M depth-sorted Gaussians at P pixels: α_i Π_{j<i} (1 − α_j)."""
    dx, dy = (pixels[:, None] - means2d[None]).unbind(-1)
    a, b, c = conics.unbind(-1)
    alpha = (opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp_max(max_alpha)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, -1)
    alpha = torch.where(after > T_MIN, alpha, torch.zeros_like(alpha))
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], -1), -1)[:, : alpha.shape[1]]
    return alpha * before
