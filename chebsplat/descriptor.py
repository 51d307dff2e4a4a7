"""Chebyshev descriptors of regions of Gaussians over the whole spectrum, without eigenvectors (Eqs 4-6)."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.albo import canonicalize, metric_factors, rotations_about, similarity, tangent_axis
from chebsplat.rasterize.projection import rotation_matrices


def chebyshev_diagonals(S: Tensor, max_degree: int) -> Tensor:
    """Diagonals of T_d(−S) − T_d(0) I for d = 2...max_degree.

    Args: S [..., n, n] symmetric, spectrum within [-1, 1], zero diagonal.
    Returns: [..., n, max_degree - 1].
    Choices: E_m = T_m − T_m(0) I is carried, so nothing of size 1 is ever subtracted; the diagonals of T_2m and
    T_2m+1 are row products of T_m and T_m+1, so max_degree 8 costs three matrix products.
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


def describe_regions(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    *,
    n_angles: int = 4,
    max_degree: int = 8,
    anisotropy: float = 30.0,
    bandwidth: float = 0.7,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Descriptor of every Gaussian of every region.

    Args: as `albo.canonicalize`; `dtype` is that of the operator and recurrence, canonicalisation is float64.
    Returns: [M, n, J, D - 1], zero where padded; g^d(i) = n ([T_d(−S)]_ii − T_d(0)), the printed formula with K = n
      and λ_max = 2; degrees 0 and 1 are identically zero and left out.
    Raises: ValueError on sizes or parameters that make no sense.
    Choices: angles j and J − j are replaced by half their sum and half their absolute difference, so that the sign of
    the axis does not matter; angles j > 0 fade to angle 0 where the axis is ill-defined.
    """
    if n_angles < 1 or max_degree < 2 or bandwidth <= 0 or anisotropy < 0:
        raise ValueError("n_angles >= 1, max_degree >= 2, bandwidth > 0 and anisotropy >= 0 are needed")
    if means.shape != scales.shape or rotmats.shape != (*means.shape, 3) or mask.shape != means.shape[:2]:
        raise ValueError(f"shapes disagree: {means.shape}, {scales.shape}, {rotmats.shape}, {mask.shape}")
    region = canonicalize(means, scales, rotmats, mask)
    factors = metric_factors(region, anisotropy)
    axis, certainty = tangent_axis(region)
    count = region.mask.sum(1)[:, None, None]
    angles = []
    for rotation in rotations_about(axis, n_angles):
        S = similarity(region, factors, rotation, bandwidth).to(dtype)
        angles.append(chebyshev_diagonals(S, max_degree) * count)
    certainty = certainty.to(dtype)[:, None, None]
    paired = [angles[0]]
    for j in range(1, n_angles):
        low, high = angles[min(j, n_angles - j)], angles[max(j, n_angles - j)]
        if j <= n_angles - j:
            paired.append(angles[0] + certainty * (0.5 * (low + high) - angles[0]))
        else:
            paired.append(certainty * 0.5 * (low - high).abs())
    return torch.where(region.mask[..., None, None], torch.stack(paired, 2), 0.0)


def describe_members(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    members: Tensor,
    *,
    n_angles: int,
    max_degree: int,
    anisotropy: float,
    bandwidth: float,
    chunk: int = 512,
) -> Tensor:
    """`describe_regions` of Gaussians [N] gathered by `members` i64 [M, n], -1 where padded; `chunk` bounds memory.

    Returns: [M, n, J, D - 1] float32.
    """
    parts = [torch.zeros(0, members.shape[1], n_angles, max_degree - 1)]
    for part in members.split(chunk):
        index = part.clamp_min(0)
        parts.append(
            describe_regions(
                means[index],
                scales[index],
                rotation_matrices(quats[index].reshape(-1, 4)).reshape(*index.shape, 3, 3),
                part >= 0,
                n_angles=n_angles,
                max_degree=max_degree,
                anisotropy=anisotropy,
                bandwidth=bandwidth,
            )
        )
    return torch.cat(parts)
