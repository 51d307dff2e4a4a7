"""Chebyshev descriptors of regions of Gaussians (Eqs 4-6): the torch route, differentiable and of any precision, and
the compiled one that stages and training use.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from chebsplat.shape import descriptor_arrays as arrays
from chebsplat.shape.albo import canonicalize, metric_factors, rotations_about, similarity, tangent_axis
from chebsplat.shape.spectra import cut_spectrum
from chebsplat.splats.rotations import rotation_matrices

Spectrum = Literal["full", "taper", "hard"]


class Described(NamedTuple):
    """values f32 [M, n, J, P]; of the n_cuts cuts of the spectrum (region and angle), n_clustered fell into a cluster
    of eigenvalues; n_exact regions took the float64 operator. All counts are 0 where they do not apply.
    """

    values: Tensor
    n_cuts: int = 0
    n_clustered: int = 0
    n_exact: int = 0


def n_degrees(spectrum: Spectrum, max_degree: int) -> int:
    """P, values of one angle: degrees 2...D of the full spectrum, whose first two vanish, and 0...D of a cut one."""
    return max_degree - 1 if spectrum == "full" else max_degree + 1


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


def describe_reference(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    *,
    n_angles: int = 8,
    max_degree: int = 8,
    anisotropy: float = 10.0,
    bandwidth: float = 0.7,
    spectrum: Spectrum = "full",
    n_eigs: int = 16,
    dtype: torch.dtype = torch.float64,
) -> Described:
    """Descriptor of every Gaussian of every region, in torch: the oracle, and differentiable with the full spectrum.

    Args: as `albo.canonicalize`; `dtype` is that of the recurrence, all before it is float64; `n_eigs` is K of a cut
      spectrum (see `spectra`).
    Returns: values [M, n, J, P], zero where padded and in regions of fewer than two Gaussians, which have no edge;
      g^d(i) = n ([T_d(−S)]_ii − T_d(0)), the printed formula with K = n and λ_max = 2; degrees 0 and 1 are
      identically zero and left out.
    Raises: ValueError on sizes or parameters that make no sense.
    Choices: angles j and J − j are replaced by half their sum and half their absolute difference, so that the sign of
    the axis does not matter; angles j > 0 fade to angle 0 where the axis is ill-defined; the axis has no gradient.
    """
    arrays.check(means, scales, rotmats, mask, n_angles, max_degree, anisotropy, bandwidth, n_eigs)
    region = canonicalize(means, scales, rotmats, mask)
    factors = metric_factors(region, anisotropy)
    axis, certainty = tangent_axis(region)
    count = region.mask.sum(1)[:, None, None]
    angles, n_cuts, n_clustered = [], 0, 0
    for rotation in rotations_about(axis, n_angles):
        S = similarity(region, factors, rotation, bandwidth)
        if spectrum == "full":
            angles.append(chebyshev_diagonals(S.to(dtype), max_degree) * count)
        else:
            cut = cut_spectrum(S, region.mask, n_eigs, max_degree, hard=spectrum == "hard")
            angles.append(cut.values.to(dtype))
            n_cuts, n_clustered = n_cuts + cut.n_cuts, n_clustered + cut.n_clustered
    certainty = certainty.to(dtype)[:, None, None]
    paired = [angles[0]]
    for j in range(1, n_angles):
        low, high = angles[min(j, n_angles - j)], angles[max(j, n_angles - j)]
        if j <= n_angles - j:
            paired.append(angles[0] + certainty * (0.5 * (low + high) - angles[0]))
        else:
            paired.append(certainty * 0.5 * (low - high).abs())
    keep = region.mask[..., None, None] & (count[..., None] > 1)
    return Described(torch.where(keep, torch.stack(paired, 2), 0.0), n_cuts, n_clustered)


def describe_compiled(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    *,
    n_angles: int = 8,
    max_degree: int = 8,
    anisotropy: float = 10.0,
    bandwidth: float = 0.7,
) -> Described:
    """`describe_reference` of the full spectrum, compiled: `descriptor_arrays.describe_regions`, of tensors."""
    given = [v.detach().numpy() for v in (means, scales, rotmats, mask)]
    sizes: dict[str, Any] = {"n_angles": n_angles, "max_degree": max_degree}
    values, n_exact = arrays.describe_regions(*given, **sizes, anisotropy=anisotropy, bandwidth=bandwidth)
    return Described(torch.from_numpy(values), n_exact=n_exact)


def describe_regions(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    *,
    spectrum: Spectrum = "full",
    n_eigs: int = 16,
    dtype: torch.dtype = torch.float32,
    **parameters: Any,
) -> Tensor:
    """Descriptors [M, n, J, P] by the fastest route: compiled for the full spectrum in float32 without a gradient,
    else `describe_reference`, which documents the arguments.
    """
    given = (means, scales, rotmats, mask)
    if spectrum == "full" and dtype == torch.float32 and not any(v.requires_grad for v in given):
        return describe_compiled(*given, **parameters).values
    return describe_reference(*given, spectrum=spectrum, n_eigs=n_eigs, dtype=dtype, **parameters).values


@torch.no_grad()
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
    spectrum: Spectrum = "full",
    n_eigs: int = 16,
    chunk: int = 2048,
) -> Described:
    """Descriptors of Gaussians [N] gathered by `members` i64 [M, n], -1 where padded; `chunk` bounds memory."""
    sizes: dict[str, Any] = {"n_angles": n_angles, "max_degree": max_degree}
    sizes |= {"anisotropy": anisotropy, "bandwidth": bandwidth}
    if spectrum == "full":
        plain = (v.numpy() for v in (means, quats, scales, members))
        full = arrays.describe_members(*plain, **sizes, chunk=chunk)
        return Described(torch.from_numpy(full.values), n_exact=full.n_exact)
    values = [torch.zeros(0, members.shape[1], n_angles, n_degrees(spectrum, max_degree))]
    counts = np.zeros(3, np.int64)
    for part in members.split(min(chunk, 256)):
        index = part.clamp_min(0)
        rotmats = rotation_matrices(quats[index].reshape(-1, 4)).reshape(*index.shape, 3, 3)
        given = (means[index], scales[index], rotmats, part >= 0)
        found = describe_reference(*given, **sizes, spectrum=spectrum, n_eigs=n_eigs)
        values.append(found.values.float())
        counts += found[1:]
    return Described(torch.cat(values), *(int(count) for count in counts))
