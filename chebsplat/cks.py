"""The core knowledge space: a basis of the encoder's projections, carried from scene to scene (Eqs 14-15)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

EPS = torch.finfo(torch.float64).eps


def residual_of(W: Tensor, basis: Tensor) -> Tensor:
    """W − B Bᵀ W in float64, projected twice: once leaves rounding of the size of what is captured."""
    W, basis = W.double(), basis.double()
    W = W - basis @ (basis.T @ W)
    return W - basis @ (basis.T @ W)


def update(
    basis: Tensor | None,
    W: Tensor,
    *,
    energy: float = 0.96,
    tolerance: float = 0.2,
    max_rank: float = 0.5,
    rule: str = "total",
) -> tuple[Tensor, dict[str, Any]]:
    """Extend a basis by what it misses of W (Eq 15).

    Args:
      basis:     [q, r] orthonormal, or None before the first scene.
      W:         [q, p] projection of the new scene.
      energy:    fraction of energy to reach: of captured + residual (`total`), or of the residual alone (the
                 printed rule, which always adds a vector).
      tolerance: relative residual √(residual/total) below which nothing is added (κ, with ε = 0.2).
      max_rank:  ceiling of r as a fraction of q: at r = q the regulariser would vanish for ever.
    Returns: basis [q, r'] float32 with orthonormal columns, and a report of ranks and residuals.
    Raises:  ValueError on non-finite values or shapes that disagree.
    Choices: scaled by max|W|; no update if the residual is rounding, ρ ≤ 10 eps √q; new columns are orthogonalised
      twice and dropped below 1e-6; the first basis comes from the SVD of W.
    """
    if not torch.isfinite(W).all() or (basis is not None and basis.shape[0] != W.shape[0]):
        raise ValueError(f"W {tuple(W.shape)} is not finite, or does not fit the basis")
    q = W.shape[0]
    old = torch.zeros(q, 0, dtype=torch.float64) if basis is None else _orthonormal(basis.double())
    report: dict[str, Any] = {"rank_before": old.shape[1], "rank_after": old.shape[1], "rho": 0.0, "energy": 1.0}
    largest = W.double().abs().max() if W.numel() else torch.tensor(0.0)
    if largest == 0:
        return old.float(), report
    scaled = W.double() / largest
    residual = residual_of(scaled, old)
    total, missed = float((scaled**2).sum()), float((residual**2).sum())
    rho = (missed / total) ** 0.5
    report |= {"rho": rho, "energy": 1 - missed / total}
    room = int(max_rank * q) - old.shape[1]
    if rho <= max(10 * EPS * q**0.5, tolerance if basis is not None else 0.0) or room <= 0:
        return old.float(), report
    vectors, values, _ = torch.linalg.svd(residual, full_matrices=False)
    gained = torch.cumsum(values**2, 0)
    reached = (total - missed + gained) / total if rule == "total" else gained / missed
    count = min(int((reached < energy).sum()) + 1, room, len(values))
    grown = _orthonormal(torch.cat([old, vectors[:, :count]], 1))
    left = residual_of(scaled, grown)
    report |= {"rank_after": grown.shape[1], "energy": 1 - float((left**2).sum()) / total}
    return grown.float(), report


def _orthonormal(columns: Tensor) -> Tensor:
    """Gram-Schmidt, each column twice; columns that lose all but 1e-6 of their length are dropped."""
    kept = torch.zeros(columns.shape[0], 0, dtype=torch.float64)
    for column in columns.T:
        length = column.norm()
        for _ in range(2):
            column = column - kept @ (kept.T @ column)
        if column.norm() > 1e-6 * length and length > 0:
            kept = torch.cat([kept, (column / column.norm())[:, None]], 1)
    return kept


def basis_loss(projections: dict[str, Tensor], bases: dict[str, Tensor]) -> Tensor:
    """Mean over projections of ‖W − B Bᵀ W‖² / ‖W‖² (Eq 14).

    Choices: relative, so that shrinking W does not lower it: the denominator carries no gradient. The printed
      modulation α is 1 here and its size the loss' weight: learned jointly it has the trivial minimum 0, and with
      that path cut nothing else teaches it.
    """
    terms = []
    for name, B in bases.items():
        W = projections[name]
        terms.append(((W - B @ (B.T @ W)) ** 2).sum() / (W.detach() ** 2).sum().clamp_min(1e-20))
    return torch.stack(terms).mean()
