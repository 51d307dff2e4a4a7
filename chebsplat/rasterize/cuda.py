"""The CUDA backend: gsplat 1.5.3, imported on first use, with our names for its results."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.kernels.dispatch import gsplat
from chebsplat.rasterize import reference
from chebsplat.rasterize.projection import is_antialiased

MAX_ALPHA = 0.999  # built into gsplat's kernels: no ceiling above it can be had
CHUNK, MOST = 32, 512  # channels at a time by default, and the most that its kernels are made for


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
    rasterize_mode: str = "classic",
    backgrounds: Tensor | None = None,
    absgrad: bool = False,
    cell_colors: Tensor | None = None,
    harmless: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """As `reference.rasterize`, of float32 tensors on a GPU.

    Args: harmless: the Gaussians are those that `made_harmless` returns.
    Raises: ValueError unless the Gaussians are float32 on a GPU, for a `max_alpha` above 0.999, or
      beyond 512 channels; ImportError, with the remedy, without gsplat.
    Choices: gsplat fixes the ceiling of alpha at 0.999; a lower one is kept by a ceiling of
      opacities, so that no alpha exceeds it. Renders are those of the other backends where no
      opacity is above `max_alpha`; where one is, alpha is the same at its middle and lower by up to
      a hundredth around it. The gradient passes as if there were no ceiling: a Gaussian that has
      reached it can become fainter again. What lies in the near plane is cut, as elsewhere.
      Covariances are float32: a needle a billion times as long as wide is drawn wider than it is.
      All channels go at once: of gsplat's chunks only one would leave its absolute gradient. A
      broken Gaussian is replaced by an invisible one, because gsplat would draw a NaN opaque.
    """
    is_antialiased(rasterize_mode)
    if means.dtype != torch.float32 or means.device.type != "cuda":
        raise ValueError(
            f"means is {means.dtype} on {means.device}; the cuda backend takes float32 on a GPU"
        )
    n_colors, colors = colors.shape[-1], reference.with_cells(colors, cell_colors)
    if max_alpha > MAX_ALPHA:
        raise ValueError(f"max_alpha {max_alpha}; the cuda backend keeps none above {MAX_ALPHA}")
    if colors.shape[-1] > MOST:
        raise ValueError(
            f"{colors.shape[-1]} channels; the cuda backend takes at most {MOST} channels"
        )
    rasterization = gsplat().rasterization
    if len(means) == 0:  # the background: gsplat does not sort an empty scene
        empty = (
            means,
            quats,
            scales,
            opacities,
            colors[..., :n_colors],
            viewmats,
            Ks,
            width,
            height,
        )
        return reference.rasterize(
            *empty, backgrounds=backgrounds, absgrad=absgrad, cell_colors=cell_colors
        )
    if backgrounds is not None:
        backgrounds = torch.nn.functional.pad(backgrounds, (0, colors.shape[-1] - n_colors))
    gaussians = (means, quats, scales, opacities, colors)
    if not harmless:
        gaussians = made_harmless(*gaussians, max_alpha)
    nearest = float(np.nextafter(np.float32(near_plane), np.float32(np.inf)))
    renders, alphas, gsplat_meta = rasterization(
        *gaussians, viewmats, Ks, width, height,
        near_plane=nearest, far_plane=far_plane, eps2d=eps2d, sh_degree=None, packed=False,
        render_mode="RGB", backgrounds=backgrounds, absgrad=absgrad, rasterize_mode=rasterize_mode,
        channel_chunk=max(CHUNK, colors.shape[-1]),
    )  # fmt: skip
    meta = own_meta(gsplat_meta)
    if cell_colors is not None:
        meta["cells"] = reference.cell_means(renders[..., n_colors:])
    return renders[..., :n_colors], alphas, meta


def made_harmless(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    max_alpha: float = 0.99,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gaussians that gsplat draws as the other backends do: opacities at most `max_alpha`, with a
    gradient as if there were no ceiling, and 0 where a value is not finite or there is no rotation;
    quaternions scaled.

    Choices: a Gaussian's values are looked at together, by their sum, which is finite where each of
      them is (or takes one for broken whose values are beyond all measure): each question to a GPU
      takes as long as a sum.
    """
    opacities = opacities + (opacities.clamp_max(max_alpha) - opacities).detach()
    by_camera = colors.ndim == 3
    columns = [
        means,
        quats,
        scales,
        opacities[:, None],
        colors.movedim(0, 1).flatten(1) if by_camera else colors,
    ]
    values = torch.cat(columns, 1)
    longest = quats.detach().abs().amax(-1)
    whole = torch.isfinite(values.detach().sum(1)) & (longest > 1e-12)
    values = torch.where(whole[:, None], values, 0)
    means, quats, scales, alone, flat = values.split([part.shape[1] for part in columns], 1)
    quats = quats / torch.where(whole, longest, 1)[:, None] + ~whole[:, None]
    colors = flat.unflatten(1, (colors.shape[0], -1)).movedim(1, 0) if by_camera else flat
    means, quats, scales, colors = (part.contiguous() for part in (means, quats, scales, colors))
    return means, quats, scales, alone[:, 0].contiguous(), colors


def own_meta(gsplat_meta: dict[str, Any]) -> dict[str, Any]:
    """Our meta of gsplat's: radii [C, N] from its [C, N, 2], and means2d retains its gradient."""
    means2d, radii = gsplat_meta["means2d"], gsplat_meta["radii"]
    if means2d.requires_grad:
        means2d.retain_grad()
    radii = radii.amax(-1) if radii.ndim == 3 else radii
    return {
        "means2d": means2d,
        "conics": gsplat_meta["conics"],
        "depths": gsplat_meta["depths"],
        "radii": radii,
    }
