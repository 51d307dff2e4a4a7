"""The core knowledge space: a basis of the encoder's attention weights, carried from scene to scene (Eqs 14-15)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

EPS = torch.finfo(torch.float64).eps
DROPPED = 1e-6  # a column that keeps less of its length than this beside the others is dropped


def project(W: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Split W [q, p] into what the basis [q, r] captures and what it misses, both float64 [q, p].

    Choices: projected twice: once leaves in the residual rounding of the size of what is captured.
    """
    W, basis = W.double(), basis.double()
    residual = W - basis @ (basis.T @ W)
    residual = residual - basis @ (basis.T @ residual)
    return W - residual, residual


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
      basis:     [q, r] orthonormal to 1e-4, or None before the first scene.
      W:         [q, p] attention weight of the new scene.
      energy:    fraction of energy to reach: of captured + residual (`total`), or of the residual alone (the
                 printed rule, which always adds a vector).
      tolerance: κ below which the scene is no news and nothing is added (ε = 0.2).
      max_rank:  ceiling of r as a fraction of q, below 1: at r = q the regulariser would vanish for ever.
    Returns: basis [q, r'] float32 with BᵀB = I to 3e-8 (dense columns, q ≥ 32; one ulp else); the given columns
      come first, untouched. Report: `rank_before`, `rank_after`, `added`; `rho` and `rho_after`, the residual
      relative to W, before and after; `energy`, the fraction of ‖W‖² captured after.
    Raises:  ValueError on values that are not finite, shapes that disagree, a basis that is not orthonormal, or a
      rule or fraction that does not exist.
    Choices: scaled by max|W|. κ is the residual's σ_f / √Q, its rms entry, in units of W's own: √Q cancels and κ = ρ.
      No update if the residual is rounding, ρ ≤ 10 eps √q, nor, by `total`, if W is captured to `energy` already. New
      columns are orthogonalised twice. The first basis comes from the SVD of W. A basis beyond the ceiling is kept,
      never cut.
    """
    _check(basis, W, energy, max_rank, rule)
    q = W.shape[0]
    given = torch.zeros(q, 0) if basis is None else basis.float()
    rank = given.shape[1]
    report: dict[str, Any] = {"rank_before": rank, "rank_after": rank, "added": 0}
    report |= {"rho": 0.0, "rho_after": 0.0, "energy": 1.0}
    largest = W.double().abs().max() if W.numel() else torch.tensor(0.0)
    if largest == 0:
        return given, report
    old, scaled = _orthonormal(given.double()), W.double() / largest
    _, residual = project(scaled, old)
    total, missed = float((scaled**2).sum()), float((residual**2).sum())
    rho = min((missed / total) ** 0.5, 1.0)
    report |= {"rho": rho, "rho_after": rho, "energy": 1 - rho**2}
    room = int(max_rank * q) - rank
    if rho <= max(10 * EPS * q**0.5, tolerance if rank else 0.0) or room <= 0:
        return given, report
    vectors, values, _ = torch.linalg.svd(residual, full_matrices=False)
    gained = torch.nn.functional.pad(torch.cumsum(values**2, 0), (1, 0))  # by 0, 1, 2, ... of the vectors
    reached = (total - missed + gained) / total if rule == "total" else gained / missed
    count = min(int((reached < energy).sum()), room, len(values))
    if count == 0:
        return given, report
    grown = _orthonormal(torch.cat([old, vectors[:, :count]], 1))
    left = float((project(scaled, grown)[1] ** 2).sum()) / total
    report |= {"rank_after": grown.shape[1], "added": grown.shape[1] - rank}
    report |= {"rho_after": left**0.5, "energy": max(1 - left, 0.0)}
    return _rounded(grown, given), report


def _check(basis: Tensor | None, W: Tensor, energy: float, max_rank: float, rule: str) -> None:
    if W.ndim != 2 or not torch.isfinite(W).all():
        raise ValueError(f"W {tuple(W.shape)} is not finite, or not a matrix")
    if rule not in ("total", "residual"):
        raise ValueError(f"rule {rule!r} is neither 'total' nor 'residual'")
    if not (0 < energy <= 1 and 0 < max_rank < 1):
        raise ValueError(f"energy {energy} is not within (0, 1], or max_rank {max_rank} not within (0, 1)")
    if basis is None:
        return
    if basis.ndim != 2 or basis.shape[0] != W.shape[0]:
        raise ValueError(f"basis {tuple(basis.shape)} does not fit W {tuple(W.shape)}")
    error = (basis.double().T @ basis.double() - torch.eye(basis.shape[1], dtype=torch.float64)).abs()
    if basis.shape[1] and not error.max() <= 1e-4:
        raise ValueError(
            f"basis {tuple(basis.shape)} is not orthonormal: BᵀB differs from I by {float(error.max()):.1e}"
        )


def _orthonormal(columns: Tensor) -> Tensor:
    """Gram-Schmidt, each column twice; columns that lose all but `DROPPED` of their length are dropped."""
    kept = torch.zeros(columns.shape[0], 0, dtype=torch.float64)
    for column in columns.T:
        length = column.norm()
        for _ in range(2):
            column = column - kept @ (kept.T @ column)
        if column.norm() > DROPPED * length and length > 0:
            kept = torch.cat([kept, (column / column.norm())[:, None]], 1)
    return kept


def _rounded(columns: Tensor, given: Tensor) -> Tensor:
    """Orthonormal columns [q, r] in float32; the first ones are `given`.

    Each entry is rounded up or down, large entries first, whichever keeps the column's products with itself and with
    the columns before it closer to those of I. Rounding to nearest leaves 6e-8 at q = 16.
    """
    exact = columns.numpy()
    out = np.zeros(exact.shape, np.float32)
    out[:, : given.shape[1]] = given.numpy()
    for j in range(given.shape[1], exact.shape[1]):
        column = exact[:, j]
        nearest = column.astype(np.float32)
        beyond = np.nextafter(nearest, np.where(nearest < column, np.inf, -np.inf).astype(np.float32))
        choices = np.stack([nearest, beyond]).astype(np.float64)
        before = out[:, :j].astype(np.float64)
        error = np.append(before.T @ column, column @ column - 1)
        for i in np.argsort(-np.abs(column), kind="stable"):
            moved = choices[:, i] - column[i]
            change = np.append(moved[:, None] * before[i], (moved * (choices[:, i] + column[i]))[:, None], 1)
            pick = int(((error + change[1]) ** 2).sum() < ((error + change[0]) ** 2).sum())
            error = error + change[pick]
            out[i, j] = choices[pick, i]
    return torch.from_numpy(out)


class _Outside(torch.autograd.Function):
    """Share of each W's energy outside its basis, [n], and its gradient in closed form: 2 (W − B Bᵀ W) / ‖W‖².

    A graph of a dozen small operations a weight takes twice as long; torch instead of NumPy, whose products of so
    small matrices wake no threads, up to ten times.
    """

    @staticmethod
    def forward(ctx: Any, bases: list[Tensor], *weights: Tensor) -> Tensor:
        shares, ctx.slopes = [], []
        for weight, basis in zip(weights, bases, strict=True):
            W, B = weight.detach().numpy(), basis.numpy()
            largest = float(np.abs(W).max()) if W.size and B.shape[1] else 0.0
            if largest == 0:
                shares.append(0.0)
                ctx.slopes.append(torch.zeros_like(weight))
                continue
            scaled = W / largest
            rest = scaled - B @ (B.T @ scaled)
            total = float(np.square(scaled).sum())
            shares.append(float(np.square(rest).sum()) / total)
            ctx.slopes.append(torch.from_numpy(rest * (2 / total / largest)))
        return weights[0].new_tensor(shares)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *(own * factor for own, factor in zip(ctx.slopes, slope.unbind(), strict=True)))


def regularizer(W: Tensor, basis: Tensor) -> Tensor:
    """‖W − B Bᵀ W‖² / ‖W‖², in [0, 1] (Eq 14); 0 for a basis without columns, and for W = 0.

    Args: W [q, p]; basis [q, r] orthonormal.
    Choices: relative, so that shrinking W does not lower it: the denominator carries no gradient. Scaled by max|W|
      first, so that 1e±25 neither overflows nor vanishes. The printed α is `train.weight_basis`: learned by this loss
      its best value would be 0, and without a gradient from it nothing teaches it.
    """
    return basis_loss({"": W}, {"": basis})


def basis_loss(attention: dict[str, Tensor], bases: dict[str, Tensor]) -> Tensor:
    """Mean over attention weights of `regularizer`; 0 without bases (the first scene)."""
    if not bases:
        return torch.tensor(0.0)
    loss: Tensor = _Outside.apply(list(bases.values()), *(attention[name] for name in bases)).mean()
    return loss
