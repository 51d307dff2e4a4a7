"""The CPU backend: projection, binning and tiles in numba, one pass for all channels; float32."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.rasterize import binning, ellipses, tiles, tiles_adjoint
from chebsplat.rasterize.projection import compensated, is_antialiased

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "cell_colors")


class _Project(torch.autograd.Function):
    """means2d [N, 2], covariances [N, 3], compensations [N] of one view; the rest without gradient.

    What comes back for `covariances`, which stay between the two Functions, is not their gradient
    but the whitened moments that `ellipses.project_adjoint` takes: they keep the precision that the
    gradient would lose.
    """

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, camera: tuple[Any, ...]
    ) -> tuple[Tensor, ...]:
        gaussians = [t.detach().contiguous().numpy() for t in (means, quats, scales)]
        projected = [torch.from_numpy(a) for a in ellipses.project(*gaussians, *camera)]
        means2d, covariances, whitening, conics, depths, radii, compensations = projected
        ctx.gaussians, ctx.camera, ctx.radii = gaussians, (*camera[:4], camera[-1]), radii.numpy()
        ctx.mark_non_differentiable(whitening, conics, depths, radii)
        return means2d, covariances, whitening, conics, depths, radii, compensations

    @staticmethod
    def backward(
        ctx: Any, grad_means2d: Tensor, moments: Tensor, *others: Tensor
    ) -> tuple[Tensor | None, ...]:
        slopes = [g.contiguous().numpy() for g in (grad_means2d, moments, others[-1])]
        inputs = [*ctx.gaussians, *ctx.camera, ctx.radii, *slopes]
        gradients = ellipses.project_adjoint(*inputs)
        return *(torch.from_numpy(a) for a in gradients), None


class _Composite(torch.autograd.Function):
    """Render [H, W, D], cell means, alpha [H, W] of one view; backward adds to any `absgrad`."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, covariances: Tensor, opacities: Tensor, colors: Tensor,
        cell_colors: Tensor, whitening: Tensor, depths: Tensor, radii: Tensor,
        absgrad: Tensor | None, size: tuple[int, int], max_alpha: float, view: int,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        centers, spreads, strengths, whitened, z, reach = (
            t.detach().contiguous().numpy()
            for t in (means2d, covariances, opacities, whitening, depths, radii)
        )
        channels, in_cells = (
            colors.detach().contiguous().numpy(),
            cell_colors.detach().contiguous().numpy(),
        )
        bins = binning.bin_gaussians(
            centers, spreads, z, reach, strengths, channels, in_cells, *size
        )
        splats = tiles.pack(bins.order, centers, whitened, strengths, channels, in_cells)
        limit = np.float32(max_alpha)
        counts = channels.shape[1], in_cells.shape[1]
        composed = tiles.forward(splats, bins.tile_starts, bins.rank, *counts, *size, limit)
        render, cells, transmittance, masks, used = composed
        ctx.arrays, ctx.absgrad = (len(centers), splats, *bins, masks, used, limit), absgrad
        ctx.view = view
        return (
            torch.from_numpy(render),
            torch.from_numpy(cells),
            1 - torch.from_numpy(transmittance),
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        inputs = [*ctx.arrays, *(g.contiguous().numpy() for g in grads), ctx.absgrad is not None]
        *gradients, finite = tiles_adjoint.backward(*inputs)
        if not finite:
            raise ValueError(f"the gradient of the image of view {ctx.view} is not finite")
        to_means2d, moments, to_opacities, absolute, *to_channels = (
            torch.from_numpy(a) for a in gradients
        )
        if ctx.absgrad is not None:
            ctx.absgrad += absolute
        return to_means2d, moments, to_opacities, *to_channels, *[None] * 7


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
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """As `reference.rasterize`, in float32, and fast.

    Raises: ValueError unless all inputs are float32 on the CPU, if a gradient to a camera is asked
      for, or, in backward, on a gradient of the image that is not finite.
    Choices: `conics`, `depths` and `radii` have no gradient here. Bitwise equal for any number of
      threads.
    """
    in_cells = torch.zeros(len(means), 0) if cell_colors is None else cell_colors
    inputs = means, quats, scales, opacities, colors, viewmats, Ks, in_cells
    for name, tensor in zip(NAMES, inputs, strict=True):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}; the cpu backend takes "
                "float32 on the CPU"
            )
    if viewmats.requires_grad or Ks.requires_grad:
        raise ValueError("the cpu backend gives cameras no gradient: use the reference")
    antialiased = is_antialiased(rasterize_mode)
    frame = (width, height, near_plane, far_plane, eps2d)
    cameras = [
        (*(t.detach().double().contiguous().numpy() for t in pair), *frame)
        for pair in zip(viewmats, Ks, strict=True)
    ]
    views = [_Project.apply(means, quats, scales, camera) for camera in cameras]
    projected = (_stack(parts) for parts in zip(*views, strict=True))
    means2d, covariances, whitening, conics, depths, radii, compensations = projected
    if means2d.requires_grad:
        means2d.retain_grad()
    absolute = torch.zeros(means2d.shape if absgrad else (0,))
    if absgrad:
        means2d.absgrad = absolute  # type: ignore[attr-defined]
    composed = [
        _Composite.apply(
            means2d[c], covariances[c],
            compensated(opacities, compensations[c]) if antialiased else opacities,
            colors if colors.ndim == 2 else colors[c],
            in_cells if in_cells.ndim == 2 else in_cells[c],
            whitening[c], depths[c], radii[c],
            absolute[c] if absgrad else None, (width, height), max_alpha, c,
        )
        for c in range(len(cameras))
    ]  # fmt: skip
    renders, cells, alphas = (_stack(parts) for parts in zip(*composed, strict=True))
    if backgrounds is not None:
        renders = renders + (1 - alphas)[..., None] * backgrounds[:, None, None]
    meta = {"means2d": means2d, "conics": conics, "depths": depths, "radii": radii}
    if cell_colors is not None:
        meta["cells"] = cells
    return renders, alphas[..., None], meta


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    """torch.stack, without a copy for one view."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)
