"""The anisotropic 3D Gaussian Chebyshev descriptor (Eqs 1-6).

`...` are regions, n their members; `present` [..., n] is false where a member is padding. The print
names neither the neighbours of a Gaussian (here: all of its region) nor the axis of the rotations
(here: z).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

ROUNDING = 1e-12  # of an eigenvalue: below, it is zero
# of degrees, the least over the largest, down to which D^-1/2 loses no figures that count
CONDITION = 1e-8


def metric(covariances: Tensor, beta: float) -> Tensor:
    """M_i = R_i diag(1 / (1 + beta lambda)) R_i^T of covariances [..., 3, 3] (Eq 1)."""
    values, axes = symmetric_eigh(covariances)
    shrunk = 1 / (1 + beta * values.clamp_min(0))
    shaped: Tensor = (axes * shrunk[..., None, :]) @ axes.mT
    return shaped


def edge_weights(centers: Tensor, metrics: Tensor, present: Tensor, sigma: float) -> Tensor:
    """w_ij = exp(-(c_i - c_j)^T (M_i + M_j) / 2 (c_i - c_j) / sigma^2), [..., n, n] (Eq 2).

    Args: centers [..., n, 3], metrics [..., n, 3, 3]; sigma in the unit of the centres.
    Returns: zero on the diagonal and for absent members.
    """
    apart = centers[..., :, None, :] - centers[..., None, :, :]
    by_own = torch.einsum("...ija,...iab,...ijb->...ij", apart, metrics, apart)
    distances = 0.5 * (by_own + by_own.mT)
    weights = (-distances / sigma**2).exp()
    neighbours = present[..., :, None] & present[..., None, :]
    neighbours = neighbours & ~torch.eye(present.shape[-1], dtype=torch.bool, device=present.device)
    return torch.where(neighbours, weights, 0.0)


def laplacian(weights: Tensor, present: Tensor) -> Tensor:
    """L = I - D^-1 W, [..., n, n] (Eq 3).

    Where a_i = 0 the print divides by zero: a Gaussian without neighbours keeps L_ii = 1 alone.
    """
    degree = weights.sum(-1, keepdim=True)
    shares = torch.where(degree > 0, weights / torch.where(degree > 0, degree, 1.0), 0.0)
    return torch.diag_embed(present.to(weights.dtype)) - shares


def eigenpairs(weights: Tensor, present: Tensor, n_eigs: int) -> tuple[Tensor, Tensor]:
    """The K smallest eigenvalues [..., K] of L and its right eigenvectors [..., n, K], |phi_k| = 1.

    L is not symmetric; with v of the symmetric D^1/2 L D^-1/2, phi = D^-1/2 v has the same
    eigenvalue. Where degrees a_i lie too far apart for that, L itself is decomposed, at ten times
    the cost.
    Choices: the print does not say which K (the smoothest), nor which vectors span an eigenvalue
      that is there twice (those that LAPACK returns). A region of fewer than K members has zeros
      beyond.
    """
    n, dtype, shape = weights.shape[-1], weights.dtype, weights.shape[:-2]
    weights, present = (
        weights.reshape(shape.numel(), n, n).double(),
        present.reshape(shape.numel(), n),
    )
    degree = weights.sum(-1)
    attached = degree > 0
    root = torch.where(attached, degree, 1.0).rsqrt()
    # absent members come last
    beyond = torch.diag_embed(torch.where(present, 1.0, 10.0).to(weights))
    values, vectors = symmetric_eigh(beyond - root[..., :, None] * weights * root[..., None, :])
    vectors = root[..., None] * vectors
    least = degree.masked_fill(~attached, torch.inf).amin(-1)
    if (ill_conditioned := least < CONDITION * degree.amax(-1)).any():
        operator = laplacian(weights[ill_conditioned], present[ill_conditioned])
        absent = torch.where(present[ill_conditioned], 0.0, 10.0).to(weights)
        roots, right = torch.linalg.eig(operator + torch.diag_embed(absent))
        order = roots.real.argsort(-1)
        values[ill_conditioned] = roots.real.gather(-1, order)
        vectors[ill_conditioned] = right.real.gather(-1, order[..., None, :].expand_as(right))
    count = min(n_eigs, n)
    is_there = torch.arange(count) < present.sum(-1, keepdim=True)
    values = torch.where(is_there, values[..., :count], 0.0)
    vectors = torch.where(present[..., None] & is_there[..., None, :], vectors[..., :count], 0.0)
    lengths = vectors.norm(dim=-2, keepdim=True)
    vectors = vectors / torch.where(lengths > 0, lengths, 1.0)
    return values.reshape(*shape, count).to(dtype), vectors.reshape(*shape, n, count).to(dtype)


def chebyshev(values: Tensor, vectors: Tensor, degree: int) -> Tensor:
    """g_i^d = sum_k T_d(2 lambda_k / lambda_max - 1) phi_k(i)^2, [..., n, degree + 1] (Eq 4).

    lambda_max is the largest of the selected. Where it is zero the quotient is taken for zero.
    """
    largest = values.amax(-1, keepdim=True)
    is_flat = largest < ROUNDING
    scaled = torch.where(is_flat, -1.0, 2 * values / torch.where(is_flat, 1.0, largest) - 1)
    polynomials = [torch.ones_like(scaled), scaled]
    for _ in range(degree - 1):
        polynomials.append(2 * scaled * polynomials[-1] - polynomials[-2])
    return vectors.square() @ torch.stack(polynomials[: degree + 1], -1)


@torch.no_grad()
def descriptor(
    centers: Tensor,
    covariances: Tensor,
    present: Tensor,
    angles: Tensor,
    *,
    beta: float,
    sigma: float,
    n_eigs: int,
    degree: int,
) -> Tensor:
    """f(G_i) = concat over angles of [g^0, ..., g^D], [..., n, J (D + 1)] (Eqs 5-6).

    Args: centers [..., n, 3], covariances [..., n, 3, 3]; angles [J] radians.
    Choices: no gradient, since eigenvectors have none where eigenvalues coincide.
    """
    if present.shape[-1] == 0:
        return centers.new_zeros(*present.shape, len(angles) * (degree + 1))
    metrics = metric(covariances, beta)
    parts = []
    for angle in angles.to(centers):
        rotation = _about_z(angle)
        weights = edge_weights(centers, rotation @ metrics @ rotation.T, present, sigma)
        parts.append(chebyshev(*eigenpairs(weights, present, n_eigs), degree))
    return torch.where(present[..., None], torch.cat(parts, -1), 0.0)


def symmetric_eigh(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """`torch.linalg.eigh` by NumPy: torch wakes all threads for each small matrix."""
    values, vectors = np.linalg.eigh(matrices.numpy())
    return torch.from_numpy(values), torch.from_numpy(vectors)


def _about_z(angle: Tensor) -> Tensor:
    """Rotation [3, 3] by an angle about z."""
    rotation = torch.eye(3, dtype=angle.dtype)
    rotation[0, 0] = rotation[1, 1] = angle.cos()
    rotation[1, 0] = angle.sin()
    rotation[0, 1] = -angle.sin()
    return rotation
