"""From regions to points (Eqs 8-9). A pair: a point i64 [E] and a region i64 [E] that holds it."""

from __future__ import annotations

import torch
from torch import Tensor

from chebsplat.printed.descriptor import symmetric_eigh

THINNEST, LEAST = 1e-12, 1e-30  # of a covariance's eigenvalues: relative to its largest, and at all


def weights(
    points: Tensor,
    centers: Tensor,
    covariances: Tensor,
    pairs: tuple[Tensor, Tensor],
    temperature: float,
) -> Tensor:
    """omega_i(q) / sum_j omega_j(q) of each pair [E], over all regions that hold q (Eqs 8-9).

    omega_i(q) = exp(-(q - c_i)^T Sigma_i^-1 (q - c_i) / tau)

    Args: points [P, 3]; centers [M, 3] and covariances [M, 3, 3] of the Gaussians at the centres.
    Choices: a Gaussian is far smaller than its region, so that all weights of a point underflow and
      the print is 0/0. The largest exponent is subtracted first, which changes no quotient.
    """
    point, region = pairs
    values, axes = symmetric_eigh(covariances)
    values = torch.maximum(values, (THINNEST * values[:, -1:]).clamp_min(LEAST))
    along = ((points[point] - centers[region])[:, None, :] @ axes[region])[:, 0]
    exponents = -(along.square() / values[region]).sum(-1) / temperature
    largest = torch.full((len(points),), -torch.inf, dtype=points.dtype)
    largest.scatter_reduce_(0, point, exponents, "amax")
    unnormalised = (exponents - largest[point]).exp()
    total = torch.zeros(len(points), dtype=points.dtype).index_add(0, point, unnormalised)
    shares: Tensor = unnormalised / total[point]
    return shares


def propagate(
    encodings: Tensor, shares: Tensor, pairs: tuple[Tensor, Tensor], n_points: int
) -> Tensor:
    """f_shape [P, C] of points from encodings [M, C] and `weights` [E] (Eq 9); 0 in no region."""
    point, region = pairs
    shape = encodings.new_zeros(n_points, encodings.shape[1])
    return shape.index_add(0, point, shares[:, None] * encodings.index_select(0, region))
