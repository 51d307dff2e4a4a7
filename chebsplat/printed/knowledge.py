"""The core knowledge space: a basis B [q, r] of each key projection matrix W [q, d] (Eqs 14-15)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

DEPENDENT = 1e-8  # length below which a column adds nothing to those before it


def projected(W: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
    """B B^T W and the residual R = W - B B^T W."""
    captured = B @ (B.mT @ W)
    return captured, W - captured


def projection_error(W: Tensor, B: Tensor) -> Tensor:
    """rho = |R| / |W| (Frobenius); 0 for W = 0, which misses nothing."""
    size = W.norm()
    return torch.where(size > 0, projected(W, B)[1].norm() / torch.where(size > 0, size, 1.0), 0.0)


class Modulation(nn.Module):
    """alpha of the mean z of a region's tokens, by one layer.

    The layer's activation is open: a sigmoid. It learns with all else, as printed; the loss that it
    weighs is the only one that reaches it, and pulls alpha to 0.
    """

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(width, 1)

    def forward(self, z: Tensor, present: Tensor) -> Tensor:
        """z [M, t, Q] with the learned token, present [M, t] -> alpha [M]."""
        mean = torch.where(present[..., None], z, 0.0).sum(-2)
        mean = mean / present.sum(-1, keepdim=True).clamp_min(1)
        alpha: Tensor = self.linear(mean)[:, 0].sigmoid()
        return alpha


def regularizer(W: Tensor, B: Tensor, alpha: Tensor) -> Tensor:
    """alpha |W - B B^T W|^2 / |W|^2 (Eq 14), the denominator differentiated too; 0 for W = 0."""
    size = W.square().sum()
    missed = projected(W, B)[1].square().sum()
    return alpha * torch.where(size > 0, missed / torch.where(size > 0, size, 1.0), 0.0)


def spread(descriptors: Tensor, present: Tensor) -> Tensor:
    """sigma_f [...] of each region's descriptors [..., n, Q] (Eq 15); 0 without members."""
    is_there = present[..., None]
    count = present.sum(-1).clamp_min(1)
    mean = torch.where(is_there, descriptors, 0.0).sum(-2, keepdim=True) / count[..., None, None]
    away = torch.where(is_there, descriptors - mean, 0.0)
    return (away.square().sum((-1, -2)) / count).sqrt()


def update(
    W: Tensor, B: Tensor | None, sigma_f: float, *, kappa: float, epsilon: float, eta: float
) -> Tensor:
    """B <- orth([B, U]) with the top left singular vectors U of R that hold eta of its energy.

    Only if rho' = rho (1 + kappa sigma_f) exceeds epsilon. No basis yet: R = W. As printed, nothing
    keeps r below q: a basis that has reached it misses nothing, and pulls at nothing.
    Returns: [q, r'] orthonormal columns, those of B first.
    """
    W = W.detach()
    if B is None:
        B = W.new_zeros(len(W), 0)
    rho = float(projection_error(W, B))
    if not W.any() or rho * (1 + kappa * sigma_f) <= epsilon:
        return B
    U, values, _ = torch.linalg.svd(projected(W, B)[1], full_matrices=False)
    energy = values.square().cumsum(0)
    count = int((energy < eta * energy[-1]).sum()) + 1
    return _orthonormal(torch.cat([B, U[:, :count]], 1), n_fixed=B.shape[1])


def _orthonormal(columns: Tensor, n_fixed: int) -> Tensor:
    """Gram-Schmidt, each column twice, after the first `n_fixed`; dependent columns are dropped."""
    basis = columns[:, :n_fixed]
    for column in columns[:, n_fixed:].mT:
        for _ in range(2):
            column = column - basis @ (basis.mT @ column)
        length = column.norm()
        if length > DEPENDENT and basis.shape[1] < len(column):
            basis = torch.cat([basis, (column / length)[:, None]], 1)
    return basis
