"""The descriptor in torch: the oracle of `descriptor_kernel`, differentiable, of any precision."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.shape.albo import (
    canonicalize,
    metric_factors,
    rotations_about,
    similarity,
    tangent_axis,
)
from chebsplat.shape.described import Descriptor


def chebyshev_diagonals(S: Tensor, max_degree: int) -> Tensor:
    """Diagonals of T_d(−S) − T_d(0) I for d = 2...max_degree.

    Args: S [..., n, n] symmetric, spectrum within [-1, 1], zero diagonal.
    Returns: [..., n, max_degree - 1].
    Choices: E_m = T_m − T_m(0) I is carried, so nothing of size 1 is ever subtracted; the diagonals
      of T_2m and T_2m+1 are row products of T_m and T_m+1, so max_degree 8 costs three matrix
      products.
    """
    x = -S
    terms = [torch.zeros_like(x), x]
    at_zero = [1.0, 0.0]
    for m in range(1, (max_degree + 1) // 2):
        terms.append(2 * (x @ terms[m]) + 2 * at_zero[m] * x - terms[m - 1])
        at_zero.append(-at_zero[m - 1])
    diagonals = [t.diagonal(dim1=-2, dim2=-1) for t in terms]
    columns = []
    for degree in range(2, max_degree + 1):
        m, k = degree // 2, degree - degree // 2
        rows = (terms[m] * terms[k]).sum(-1)
        columns.append(2 * (rows + at_zero[m] * diagonals[k] + at_zero[k] * diagonals[m]))
    return torch.stack(columns, -1)


def describe(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    parameters: Descriptor,
    *,
    dtype: torch.dtype,
) -> Tensor:
    """Values as of `descriptor.describe`; `dtype` is that of the recurrence, all before it is
    float64.

    Choices: angles j and J − j are replaced by half their sum and half their absolute difference,
      so that the sign of the axis does not matter; angles j > 0 fade to angle 0 where the axis is
      ill-defined; the axis has no gradient.
    """
    region, n_angles = canonicalize(means, scales, rotmats, mask), parameters.n_angles
    factors = metric_factors(region, parameters.anisotropy)
    around, certainty = tangent_axis(region)
    count = region.mask.sum(1)[:, None, None]
    angles = []
    for rotation in rotations_about(around, n_angles):
        S = similarity(region, factors, rotation, parameters.bandwidth)
        angles.append(chebyshev_diagonals(S.to(dtype), parameters.max_degree) * count)
    certainty = certainty.to(dtype)[:, None, None]
    keep = region.mask[..., None, None] & (count[..., None] > 1)
    paired = angles[:1]
    for j in range(1, n_angles):
        low, high = angles[min(j, n_angles - j)], angles[max(j, n_angles - j)]
        if j <= n_angles - j:
            paired.append(angles[0] + certainty * (0.5 * (low + high) - angles[0]))
        else:
            paired.append(certainty * 0.5 * (low - high).abs())
    return torch.where(keep, torch.stack(paired, 2), 0.0)
