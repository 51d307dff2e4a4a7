"""Colour by spherical harmonics of the Gaussians in view, in numba: a Gaussian costs only the bands it keeps.

Twin of `sh.eval_sh` with `sh_prune.masked_sh`, which are its oracles; reads and writes whole parameters, so that no
copy of the coefficients in view is ever made.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.jit import inline, kernel, prange

ENDS = np.array([1, 4, 9, 16])  # coefficients up to each band


@inline
def _basis(means, eye, i, degree, out):
    """Fill basis values of the bands up to `degree`, seen from `eye`: as `sh.basis`."""
    x, y, z = means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / length, y / length, z / length
    out[0] = 0.28209479177387814
    if degree >= 1:
        c = 0.4886025119029199
        out[1], out[2], out[3] = -c * y, c * z, -c * x
    if degree >= 2:
        c = 1.0925484305920792
        out[4], out[5], out[6] = c * x * y, -c * y * z, 0.31539156525252005 * (3 * z * z - 1)
        out[7], out[8] = -c * x * z, 0.5 * c * (x * x - y * y)
    if degree >= 3:
        c, d = 0.5900435899266435, 0.4570457994644658
        out[9], out[10] = -c * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z
        out[11], out[12] = -d * y * (5 * z * z - 1), 0.3731763325901154 * z * (5 * z * z - 3)
        out[13], out[14] = -d * x * (5 * z * z - 1), 1.445305721320277 * z * (x * x - y * y)
        out[15] = -c * x * (x * x - 3 * y * y)


@inline
def _kept(bands, v, degree):
    """The highest band of row v that is used: masks are nested."""
    top = 0
    while top < degree and bands[v, top] != 0:
        top += 1
    return top


@kernel
def _forward(sh0, shN, bands, index, means, eye, degree):
    out = np.empty((len(index), 3), np.float32)
    for v in prange(len(index)):
        i, top, values = index[v], _kept(bands, v, degree), np.empty(16)
        _basis(means, eye, i, top, values)
        for c in range(3):
            total = 0.5 + values[0] * sh0[i, 0, c]
            for k in range(1, ENDS[top]):
                total += values[k] * shN[i, k - 1, c]
            out[v, c] = max(total, 0.0)
    return out


@kernel
def _backward(shN, bands, index, means, eye, degree, out, grad, for_bands):
    """Gradients to sh0 [N, 1, 3], shN [N, K, 3] and, if asked for, bands [V, 3] (straight through closed ones too)."""
    n, held = len(shN), shN.shape[1]
    to_sh0, to_shN = np.empty((n, 1, 3), np.float32), np.empty((n, held, 3), np.float32)
    to_bands = np.zeros((len(index) if for_bands else 0, 3), np.float32)
    for i in prange(n):
        to_sh0[i], to_shN[i] = np.float32(0), np.float32(0)
    for v in prange(len(index)):
        i, top, values = index[v], _kept(bands, v, degree), np.empty(16)
        _basis(means, eye, i, degree if for_bands else top, values)
        for c in range(3):
            g = grad[v, c] if out[v, c] > 0 else np.float32(0)
            to_sh0[i, 0, c] = values[0] * g
            for k in range(1, ENDS[top]):
                to_shN[i, k - 1, c] = values[k] * g
            if for_bands:
                for band in range(degree):
                    total = 0.0
                    for k in range(ENDS[band], ENDS[band + 1]):
                        total += values[k] * shN[i, k - 1, c]
                    to_bands[v, band] += total * g
    return to_sh0, to_shN, to_bands


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh0, shN, bands, index, means, eye, degree):  # type: ignore[no-untyped-def, override]
        arrays = [t.detach().contiguous().numpy() for t in (sh0, shN, bands, index, means, eye)]
        out = _forward(*arrays, degree)
        ctx.arrays, ctx.degree, ctx.out = arrays, degree, out
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, grad):  # type: ignore[no-untyped-def, override]
        for_bands = ctx.needs_input_grad[2]
        found = _backward(*ctx.arrays[1:], ctx.degree, ctx.out, grad.contiguous().numpy(), for_bands)
        to_sh0, to_shN, to_bands = (torch.from_numpy(a) for a in found)
        return to_sh0, to_shN, to_bands if for_bands else None, None, None, None, None


def colors_in_view(
    sh0: Tensor, shN: Tensor, bands: Tensor | None, index: Tensor, means: Tensor, eye: Tensor, degree: int
) -> Tensor:
    """Colours [V, 3], at least 0, of the Gaussians `index` i64 [V] (no row twice) as seen from `eye` [3].

    Args: sh0 [N, 1, 3], shN [N, K, 3], means [N, 3], float32; bands [V, 3] nested masks of bands 1 to 3, None for all
      open; degree: highest band to use, 0 to 3.
    Raises: ValueError if shN holds too few coefficients for the degree.
    Choices: no gradient reaches the means through the view's direction; a closed band costs nothing, except while its
      mask still learns.
    """
    if not 0 <= degree <= 3 or shN.shape[1] < ENDS[degree] - 1:
        raise ValueError(
            f"degree {degree} needs {ENDS[min(degree, 3)] - 1} coefficients beyond band 0, not {shN.shape[1]}"
        )
    if bands is None:
        bands = torch.ones(1, 3).expand(len(index), 3)
    return _Colors.apply(sh0, shN, bands, index, means.detach(), eye, degree)
