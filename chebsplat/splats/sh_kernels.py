"""Colour by spherical harmonics in numba: a Gaussian in view costs only the bands that it keeps.

Reads and writes whole parameters, so that no copy of the coefficients in view is ever made. A band
is a tensor [N_l, 2 l + 1, 3] that the first N_l Gaussians have. `sh` holds the plain twin, and
chooses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.kernels.jit import body, kernel
from chebsplat.kernels.threads import in_parts


@body
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


@body
def _top_band(bands, n_held, i, v, degree):
    """Highest band that counts for Gaussian i, row v of the masks: it and all below are there."""
    top = 0
    while top < degree and i < n_held[top] and bands[v, top] != 0:
        top += 1
    return top


@body
def _band(values, first, band, i, c):
    """Contribution of one band to channel c of Gaussian i."""
    total = 0.0
    for k in range(band.shape[1]):
        total += values[first + k] * band[i, k, c]
    return total


@kernel
def _forward(first, last, sh0, sh1, sh2, sh3, bands, index, means, eye, degree, out):
    n_held, values = (len(sh1), len(sh2), len(sh3)), np.empty(16)
    for v in range(first, last):
        i = index[v]
        top = _top_band(bands, n_held, i, v, degree)
        _basis(means, eye, i, top, values)
        for c in range(3):
            total = 0.5 + values[0] * sh0[i, 0, c]
            if top >= 1:
                total += _band(values, 1, sh1, i, c)
            if top >= 2:
                total += _band(values, 4, sh2, i, c)
            if top >= 3:
                total += _band(values, 9, sh3, i, c)
            out[v, c] = max(total, 0.0)


@body
def _to_band(values, first, g, out, i, c):
    for k in range(out.shape[1]):
        out[i, k, c] = values[first + k] * g


@kernel
def _backward(
    first, last, sh1, sh2, sh3, bands, index, means, eye, degree, out, grad, for_bands,
    to_sh0, to_sh1, to_sh2, to_sh3, to_bands,
):  # fmt: skip
    """Gradients to sh0, each band and, if asked for, the masks [V, 3], closed ones included."""
    n_held, values = (len(sh1), len(sh2), len(sh3)), np.empty(16)
    for v in range(first, last):
        i = index[v]
        top = _top_band(bands, n_held, i, v, degree)
        _basis(means, eye, i, degree if for_bands else top, values)
        for c in range(3):
            g = grad[v, c] if out[v, c] > 0 or grad[v, c] < 0 else np.float32(0)
            to_sh0[i, 0, c] = values[0] * g
            if top >= 1:
                _to_band(values, 1, g, to_sh1, i, c)
            if top >= 2:
                _to_band(values, 4, g, to_sh2, i, c)
            if top >= 3:
                _to_band(values, 9, g, to_sh3, i, c)
            if for_bands and degree >= 1 and i < n_held[0]:
                to_bands[v, 0] += _band(values, 1, sh1, i, c) * g
            if for_bands and degree >= 2 and i < n_held[1]:
                to_bands[v, 1] += _band(values, 4, sh2, i, c) * g
            if for_bands and degree >= 3 and i < n_held[2]:
                to_bands[v, 2] += _band(values, 9, sh3, i, c) * g


@kernel
def _by_degree(first, last, sh0, shN, degrees, index, means, eye, out):
    values = np.empty(16)
    for v in range(first, last):
        i = index[v]
        _basis(means, eye, i, degrees[i], values)
        for c in range(3):
            total = 0.5 + values[0] * sh0[i, 0, c]
            for k in range((degrees[i] + 1) ** 2 - 1):
                total += values[k + 1] * shN[i, k, c]
            out[v, c] = max(total, 0.0)


def colors_by_degree(
    sh0: Tensor, shN: Tensor, degrees: Tensor, index: Tensor, means: Tensor, eye: Tensor
) -> Tensor:
    """Colours [V, 3] of the Gaussians `index` as seen from `eye` [3], each by its own bands only.

    Args: sh0 [N, 1, 3], shN [N, K, 3], means [N, 3] float32 on the CPU; degrees [N].
    """
    out = np.empty((len(index), 3), np.float32)
    arrays = [tensor.contiguous().numpy() for tensor in (sh0, shN, degrees, index, means, eye)]
    in_parts(_by_degree, len(out), *arrays, out)
    return torch.from_numpy(out)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh0, sh1, sh2, sh3, masks, index, means, eye, degree):
        arrays = [
            t.detach().contiguous().numpy() for t in (sh0, sh1, sh2, sh3, masks, index, means, eye)
        ]
        out = np.empty((len(index), 3), np.float32)
        in_parts(_forward, len(out), *arrays, degree, out)
        ctx.arrays, ctx.degree, ctx.out = arrays, degree, out
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        for_bands = ctx.needs_input_grad[4]
        gradients = [np.zeros(band.shape, np.float32) for band in ctx.arrays[:4]]
        gradients.append(np.zeros((len(grad) if for_bands else 0, 3), np.float32))
        in_parts(
            _backward, len(grad), *ctx.arrays[1:], ctx.degree, ctx.out, grad.contiguous().numpy(),
            for_bands, *gradients,
        )  # fmt: skip
        parts = [torch.from_numpy(a) for a in gradients]
        return *parts[:4], parts[4] if for_bands else None, None, None, None, None


def colors_in_view(
    bands: Sequence[Tensor],
    masks: Tensor | None,
    index: Tensor,
    means: Tensor,
    eye: Tensor,
    degree: int,
) -> Tensor:
    """`sh.colors_in_view` of float32 on the CPU; a closed band is free unless its mask learns."""
    used = [band if at <= degree else band[:0].detach() for at, band in enumerate(bands)]
    used += [bands[0].new_zeros(0, 2 * at + 1, 3) for at in range(len(used), 4)]
    if masks is None:
        masks = torch.ones(1, 3).expand(len(index), 3)
    colors: Tensor = _Colors.apply(*used, masks, index, means.detach(), eye, degree)
    return colors
