"""Colour by real spherical harmonics, in 3DGS's basis and sign convention; of each Gaussian in
view, the bands that it has and that its masks keep.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from chebsplat.kernels.dispatch import gsplat, is_compiled
from chebsplat.splats import sh_kernels
from chebsplat.splats.gaussians import take

MAX_DEGREE = 3


def n_coefficients(degree: int) -> int:
    """Coefficients of all bands up to `degree`: (degree + 1)²."""
    return (degree + 1) ** 2


def basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics with the Condon-Shortley phase.

    Args:
      directions: [N, 3] unit vectors, from the camera to the Gaussian.
      degree:     0 to 3.
    Returns: [N, (degree + 1)²], band by band, m from -l to l.
    Raises:  ValueError on a degree outside 0...3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree {degree} is not within 0...{MAX_DEGREE}")
    x, y, z = directions.unbind(-1)
    columns = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        c = 0.4886025119029199
        columns += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = 1.0925484305920792
        columns += [
            c * x * y,
            -c * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -c * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, -1)


def light(coefficients: Tensor, directions: Tensor, degree: int, backend: str = "auto") -> Tensor:
    """Light [N, 3] along directions [N, 3], normalised here, of coefficients [N, at least (degree +
    1)², 3].

    Raises: ImportError, with the remedy, on a GPU without gsplat, unless backend is `reference`.
    Choices: on a GPU gsplat's own kernel: fifty operations there would be fifty launches to wait
      for.
    """
    if coefficients.device.type == "cuda" and backend != "reference":
        colors: Tensor = gsplat().spherical_harmonics(degree, directions, coefficients)
        return colors
    values = basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    return torch.einsum("nk,nkc->nc", values, coefficients[:, : n_coefficients(degree)])


class _Floored(torch.autograd.Function):
    """Values with what is negative cut off; a gradient that would lift it back above 0 passes."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return values.clamp_min(0)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        return torch.where((values > 0) | (grad < 0), grad, 0)


def _floored(values: Tensor) -> Tensor:
    cut: Tensor = _Floored.apply(values)
    return cut


def eval_sh(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colour seen along a direction; the half-grey offset is added and negative light cut off.

    Args:
      sh0:        [N, 1, 3] coefficients of band 0.
      shN:        [N, K - 1, 3] the rest, K - 1 at least `n_coefficients(degree) - 1`.
      directions: [N, 3], from the camera to the Gaussian; normalised here.
      degree:     highest band to use.
    Returns: [N, 3], at least 0.
    """
    coefficients = torch.cat([sh0, shN[:, : n_coefficients(degree) - 1]], 1)
    return _floored(light(coefficients, directions, degree) + 0.5)


def colors_in_view(
    bands: Sequence[Tensor],
    masks: Tensor | None,
    index: Tensor | None,
    means: Tensor,
    eye: Tensor,
    degree: int,
    backend: str = "auto",
) -> Tensor:
    """Colours [V, 3], at least 0, of the Gaussians `index` i64 [V] (no row twice; None: all) as
    seen from `eye` [3].

    Args: bands: coefficients [N_l, 2 l + 1, 3] of bands 0 to 3 or fewer: the first N_l Gaussians
      have band l, N = N_0 ≥ N_1 ≥ ...; masks [V, 3] nested, of bands 1 to 3, None for all open;
      means [N, 3]; degree: the highest band to use; backend: of `rasterize`.
    Raises: ValueError if the degree is not within 0 and 3.
    Choices: no gradient reaches the means through the view's direction; a band that is not used
      gets no gradient at all, so that the optimizer leaves it out. A colour that is cut off at 0
      keeps the gradient that would lift it: a Gaussian that begins black, or has become so, can be
        seen again.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree {degree} is not within 0 and 3")
    if is_compiled(bands[0], backend):
        index = torch.arange(len(means)) if index is None else index
        return sh_kernels.colors_in_view(bands, masks, index, means, eye, degree)
    coefficients = _coefficients(bands[: degree + 1], masks, index)
    directions = take(means.detach(), index) - eye
    return _floored(light(coefficients, directions, min(degree, len(bands) - 1), backend) + 0.5)


def _coefficients(bands: Sequence[Tensor], masks: Tensor | None, index: Tensor | None) -> Tensor:
    """Masked coefficients [V, K, 3] of all bands. Choices: a band that only the first Gaussians
    have is filled up with zeros, rather than cut to those in view that have it: a cut has to wait
    for their number.
    """
    parts, n = [], len(bands[0])
    for at, band in enumerate(bands):
        whole = (
            band
            if len(band) == n
            else torch.nn.functional.pad(band, (0, 0, 0, 0, 0, n - len(band)))
        )
        rows = take(whole, index)
        parts.append(rows if masks is None or at == 0 else rows * masks[:, at - 1, None, None])
    return torch.cat(parts, 1)
