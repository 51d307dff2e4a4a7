"""gsplat 1.5.3's `rasterization` and `spherical_harmonics` without a GPU: their signatures and
rules, on our twins.

Its rules: shapes as its assertions have them, float32 on one GPU, channels in chunks whose count
  its kernels are made
for, each of which overwrites the absolute gradient of the one before; radii by axis, [C, N, 2],
int32.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from chebsplat.rasterize import reference
from chebsplat.splats.sh import basis

NATIVE = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513)
CEILING = 0.999
asked: dict[str, Any] = {}  # the options of the last call
# the last one makes what a call computes in
within: list[Callable[[], AbstractContextManager[None]]] = []


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: int = 0,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    others = (
        radial_coeffs,
        tangential_coeffs,
        thin_prism_coeffs,
        ftheta_coeffs,
        viewmats_rs,
        covars,
        sh_degree,
    )
    assert all(value is None for value in others), "an option that chebsplat never gives"
    assert not (
        packed
        or sparse_grad
        or distributed
        or segmented
        or with_ut
        or with_eval3d
        or rolling_shutter
    )
    assert (radius_clip, camera_model, render_mode) == (0, "pinhole", "RGB")
    N, C, D = len(means), len(viewmats), colors.shape[-1]
    assert means.shape == (N, 3), means.shape
    assert quats.shape == (N, 4), quats.shape
    assert scales.shape == (N, 3), scales.shape
    assert opacities.shape == (N,), opacities.shape
    assert viewmats.shape == (C, 4, 4), viewmats.shape
    assert Ks.shape == (C, 3, 3), Ks.shape
    assert colors.shape in ((N, D), (C, N, D)), colors.shape
    assert backgrounds is None or backgrounds.shape == (C, D), backgrounds
    assert N > 0, "its kernels sort no empty scene"
    assert isinstance(width, int) and isinstance(height, int), (width, height)
    for tensor in (means, quats, scales, opacities, colors, viewmats, Ks):
        assert tensor.dtype == torch.float32 and tensor.device.type == "cuda", (
            tensor.dtype,
            tensor.device,
        )
    for first in range(0, D, channel_chunk):
        chunk = min(channel_chunk, D - first)
        padded = chunk if chunk in NATIVE else 1 << (chunk - 1).bit_length()
        if padded > NATIVE[-1]:
            raise ValueError(f"Unsupported number of color channels: {chunk}")
        assert not absgrad or chunk == D, "a second chunk would overwrite the absolute gradient"
    asked.clear()
    asked.update(
        channel_chunk=channel_chunk, packed=packed, absgrad=absgrad, rasterize_mode=rasterize_mode
    )
    meta: dict[str, Any] = {}

    def render(*gaussians: Tensor) -> tuple[Tensor, Tensor]:
        image, alpha, found = reference.rasterize(
            *gaussians, viewmats, Ks, width, height,
            near_plane=near_plane, far_plane=far_plane, eps2d=eps2d, max_alpha=CEILING,
            rasterize_mode=rasterize_mode,
            backgrounds=backgrounds, absgrad=absgrad,
        )  # fmt: skip
        meta.update(found)
        return image, alpha

    image, alpha = _Kernel.apply(render, means, quats, scales, opacities, colors)
    return image, alpha, meta | {"radii": meta["radii"][..., None].expand(-1, -1, 2).int()}


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    assert masks is None, "an option that chebsplat never gives"
    assert (degrees_to_use + 1) ** 2 <= coeffs.shape[-2], coeffs.shape
    assert dirs.shape == (len(coeffs), 3) and coeffs.shape[-1] == 3
    assert (
        dirs.dtype == coeffs.dtype == torch.float32
        and dirs.device.type == coeffs.device.type == "cuda"
    )

    def shine(coefficients: Tensor) -> tuple[Tensor]:
        values = basis(torch.nn.functional.normalize(dirs, dim=-1), degrees_to_use)
        return (torch.einsum("nk,nkc->nc", values, coefficients[:, : (degrees_to_use + 1) ** 2]),)

    (light,) = _Kernel.apply(shine, coeffs)
    return light


class _Kernel(torch.autograd.Function):
    """A function of tensors with all its operations, forward and backward, within what `within`
    says.
    """

    @staticmethod
    def forward(
        ctx: Any, function: Callable[..., tuple[Tensor, ...]], *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.inputs = [tensor.detach().requires_grad_(tensor.requires_grad) for tensor in inputs]
        with _aside(), torch.set_grad_enabled(any(tensor.requires_grad for tensor in inputs)):
            ctx.outputs = function(*ctx.inputs)
        return tuple(tensor.detach() for tensor in ctx.outputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        for tensor in ctx.inputs:
            tensor.grad = None
        with _aside():
            torch.autograd.backward(ctx.outputs, grads, retain_graph=True)
        return None, *(tensor.grad for tensor in ctx.inputs)


def _aside() -> AbstractContextManager[None]:
    return within[-1]() if within else nullcontext()
