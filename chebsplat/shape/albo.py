"""Anisotropic Laplace-Beltrami operator of a region of Gaussians (Eqs 1-3), in float64."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Region(NamedTuple):
    """Regions in canonical pose-free units: rms radius 1 around the mean, float64."""

    means: Tensor  # [M, n, 3]
    scales: Tensor  # [M, n, 3]
    rotmats: Tensor  # [M, n, 3, 3]
    mask: Tensor  # [M, n] bool, false where padded or not finite


def canonicalize(means: Tensor, scales: Tensor, rotmats: Tensor, mask: Tensor) -> Region:
    """Remove a region's position and size, in float64, so that no parameter below carries units.

    Args:
      means:   [M, n, 3] scene units; subtract the scene's origin in float64 before any cast to
        float32.
      scales:  [M, n, 3] standard deviations, scene units, >= 0.
      rotmats: [M, n, 3, 3].
      mask:    [M, n] false for padding.
    Returns: the region; rows with a non-finite value join the padding and are zeroed.
    """
    finite = (
        torch.isfinite(means).all(-1)
        & torch.isfinite(scales).all(-1)
        & torch.isfinite(rotmats).all((-1, -2))
    )
    mask = mask & finite
    keep = mask[..., None]
    means = torch.where(keep, means.double(), 0.0)
    first = mask.to(torch.int8).argmax(1)
    means = means - means.gather(1, first[:, None, None].expand(-1, 1, 3))
    count = mask.sum(1).clamp_min(1)[:, None, None]
    # Two steps keep every digit of a region far from the origin; dividing by the extent first keeps
    # 1e±150 in range.
    extent = torch.where(keep, means, 0.0).abs().amax((1, 2), keepdim=True)
    extent = torch.where(extent > 0, extent, 1.0)
    means = torch.where(keep, means / extent, 0.0)
    means = torch.where(keep, means - means.sum(1, keepdim=True) / count, 0.0)
    square = (means * means).sum((1, 2), keepdim=True) / count
    radius = torch.where(square > 0, square, 1.0).sqrt()  # the root of 0 has no gradient
    scales = torch.where(keep, scales.double() / extent / radius, 0.0)
    rotmats = torch.where(keep[..., None], rotmats.double(), torch.eye(3, dtype=torch.float64))
    return Region(means / radius, scales, rotmats, mask)


def metric_factors(region: Region, anisotropy: float) -> Tensor:
    """Y_i = diag(sqrt(m_i)) R_iᵀ with m_ik = 1 / (1 + a (s_ik / s̃)²) (Eq 1): Δ has length |Y_i Δ|.

    Returns: [M, n, 3, 3].
    Choices: s̃ is the region's median largest scale, so that anisotropy does not fade with the
      scene's units; a region whose s̃ is 0 is isotropic wherever its scales are 0.
    """
    largest = region.scales.amax(-1)
    typical = (
        torch.where(region.mask, largest, torch.nan)
        .nanmedian(1)
        .values.nan_to_num(0.0)[:, None, None]
    )
    ratio = torch.where(
        typical > 0,
        region.scales / torch.where(typical > 0, typical, 1.0),
        1e150 * region.scales.sign(),
    )
    root = 1 / torch.hypot(torch.ones_like(ratio), anisotropy**0.5 * ratio)
    return root[..., None] * region.rotmats.transpose(-1, -2)


@torch.no_grad()
def tangent_axis(region: Region) -> tuple[Tensor, Tensor]:
    """Axis of least variance of the region's Gaussian mixture, and the certainty of it.

    Returns: axis [M, 3], of arbitrary sign; certainty [M], a smoothstep of the gap of the two
      smallest variances. Neither has a gradient: that of an eigenvector does not exist where
      eigenvalues meet.
    """
    widest = region.scales.amax((1, 2), keepdim=True).clamp_min(1.0)
    spread = region.rotmats * (region.scales / widest)[..., None, :]
    centers = region.means / widest
    keep = region.mask[..., None, None]
    mixture = torch.where(
        keep, spread @ spread.transpose(-1, -2) + centers[..., :, None] * centers[..., None, :], 0.0
    )
    values, vectors = torch.linalg.eigh(
        mixture.sum(1) / region.mask.sum(1).clamp_min(1)[:, None, None]
    )
    low, middle, high = values.clamp_min(0).unbind(-1)
    total = low + middle + 1e-5 * high
    gap = torch.where(total > 0, (middle - low) / torch.where(total > 0, total, 1.0), 0.0)
    t = ((gap - 0.02) / 0.08).clamp(0, 1)
    return vectors[..., 0], t * t * (3 - 2 * t)


def rotations_about(axis: Tensor, n_angles: int) -> Tensor:
    """Rotations by 2πj/J about each axis [M, 3], by Rodrigues' formula. Returns: [J, M, 3, 3].

    Choices: the full circle; only then does flipping the axis permute the angles.
    """
    angles = torch.arange(n_angles, dtype=axis.dtype) * (2 * torch.pi / n_angles)
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    sin, cos = angles.sin()[:, None, None, None], angles.cos()[:, None, None, None]
    return torch.eye(3, dtype=axis.dtype) + sin * cross + (1 - cos) * (cross @ cross)


def similarity(region: Region, factors: Tensor, rotmats: Tensor, bandwidth: float) -> Tensor:
    """S = A^-1/2 W A^-1/2: I − S is symmetric, and similar to the random-walk Laplacian of Eq 3.

    Args:
      factors: [M, n, 3, 3], from `metric_factors`.
      rotmats: [M, 3, 3], the rotation of every metric of a region.
    Returns: [M, n, n], zero diagonal, zero rows for padding.
    Choices: degrees by logsumexp and one exponential of a difference of logarithms: a region all of
      whose weights underflow still has the right operator. Differences are formed directly, never
      by the expanded square.
    """
    delta = region.means[:, :, None] - region.means[:, None]
    turned = torch.einsum("mpqk,mkl->mpql", delta, rotmats)  # (rotmatᵀ Δ) in rows
    lengths = (torch.einsum("mikl,mijl->mijk", factors, turned) ** 2).sum(-1)
    log_weights = -0.5 * (lengths + lengths.transpose(1, 2)) / bandwidth**2
    n = region.mask.shape[1]
    pair = region.mask[:, :, None] & region.mask[:, None] & ~torch.eye(n, dtype=torch.bool)
    log_weights = torch.where(pair, log_weights, 0.0)
    top = torch.where(pair, log_weights, -torch.inf).amax(-1).detach()
    top = torch.where(torch.isfinite(top), top, 0.0)
    # Not by clamp_max: from torch 2.14 on it has no gradient at the bound, where each row's top
    # lies.
    degrees = torch.where(pair, log_weights - top[..., None], -torch.inf).exp().sum(-1)
    log_degrees = top + torch.where(degrees > 0, degrees, 1.0).log()
    exponent = log_weights - 0.5 * (log_degrees[:, :, None] + log_degrees[:, None])
    return torch.where(pair, exponent.clamp_max(0).exp(), 0.0)
