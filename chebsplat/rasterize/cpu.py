"""The CPU backend: projection in torch, tiles in numba, one pass for all channels; float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from chebsplat.rasterize import kernels
from chebsplat.rasterize.projection import project
from chebsplat.rasterize.reference import ALPHA_MIN


class _Composite(torch.autograd.Function):
    """Tiles of one view. Gradients to means2d, conics, opacities and colors; `means2d.absgrad` is filled aside."""

    @staticmethod
    def forward(ctx: Any, means2d, conics, opacities, colors, holder, order, width, height, max_alpha):  # type: ignore[no-untyped-def]
        arrays = [t.detach().contiguous().numpy() for t in (means2d, conics, opacities, colors)]
        bins = kernels.bin_gaussians(*arrays[:3], order.numpy(), width, height)
        alpha_limit = kernels.np.float32(max_alpha)
        render, transmittance = kernels.forward(*arrays, bins[0], bins[1], width, height, alpha_limit)
        alpha = 1 - torch.from_numpy(transmittance)
        rendered = torch.from_numpy(render)
        ctx.arrays, ctx.bins, ctx.sizes, ctx.holder = arrays, bins, (width, height, alpha_limit), holder
        ctx.save_for_backward(rendered, alpha)
        return rendered, alpha

    @staticmethod
    def backward(ctx: Any, grad_render: Tensor, grad_alpha: Tensor):  # type: ignore[no-untyped-def]
        rendered, alpha = ctx.saved_tensors
        if not (torch.isfinite(grad_render).all() and torch.isfinite(grad_alpha).all()):
            raise ValueError("the gradient of the image is not finite")
        total = (grad_render * rendered).sum(-1) + grad_alpha * alpha
        tile_starts, gaussian, pair, pair_starts = ctx.bins
        records = kernels.backward(
            *ctx.arrays,
            tile_starts,
            gaussian,
            pair,
            *ctx.sizes,
            grad_render.contiguous().numpy(),
            total.numpy(),
            grad_alpha.contiguous().numpy(),
        )
        sums = torch.from_numpy(kernels.reduce_records(records, pair_starts))
        ctx.holder["absgrad"] = sums[:, 6:8]
        n = kernels.N_GEOMETRY
        return sums[:, :2], sums[:, 2:5], sums[:, 5], sums[:, n:], None, None, None, None, None


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
    """As `reference.rasterize`, in float32, and fast. meta also holds `absgrad`: after backward, one dict a view whose
    `absgrad` [N, 2] is the sum over pixels of the absolute gradient to the 2D means.

    Raises: ValueError unless all inputs are float32 on the CPU, or, in backward, on a non-finite image gradient.
    """
    for name, tensor in (("means", means), ("quats", quats), ("scales", scales), ("colors", colors)):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(f"{name} is {tensor.dtype} on {tensor.device}; the cpu backend takes float32 on the CPU")
    views = [project(means, quats, scales, v, k, width, height, near_plane, far_plane, eps2d)
             for v, k in zip(viewmats, Ks, strict=True)]  # fmt: skip
    means2d = torch.stack([view.means2d for view in views])
    if means2d.requires_grad:
        means2d.retain_grad()
    holders: list[dict[str, Tensor]] = [{} for _ in views]
    renders, alphas = [], []
    for c, view in enumerate(views):
        channels = colors if colors.ndim == 2 else colors[c]
        shown = view.visible & (opacities >= ALPHA_MIN) & torch.isfinite(opacities) & torch.isfinite(channels).all(-1)
        index = shown.nonzero()[:, 0]
        order = index[torch.argsort(view.depths.detach()[index], stable=True)]
        render, alpha = _Composite.apply(
            means2d[c], view.conics, opacities, channels, holders[c], order, width, height, max_alpha
        )
        if backgrounds is not None:
            render = render + (1 - alpha)[..., None] * backgrounds[c]
        renders.append(render)
        alphas.append(alpha[..., None])
    meta = {
        "means2d": means2d,
        "conics": torch.stack([view.conics for view in views]),
        "depths": torch.stack([view.depths for view in views]),
        "radii": torch.stack([view.radii for view in views]),
        "absgrad": holders,
    }
    return torch.stack(renders), torch.stack(alphas), meta
