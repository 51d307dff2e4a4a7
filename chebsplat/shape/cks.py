"""The core knowledge space: a basis of each of the encoder's linear maps, carried from scene to scene (Eqs 14-15).

A map takes z to z W, W [q, p]: the transpose of `nn.Linear.weight`. Its basis [q, r] spans inputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.kernels.dispatch import is_compiled

EPS = torch.finfo(torch.float64).eps
DROPPED = 1e-6  # a column that keeps less of its length than this beside the others is dropped
WEAKEST, STRONGEST = 1e-3, 10.0  # α, at least and at most


def project(W: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Split W [q, p] into what the basis [q, r] captures and what it misses, both float64 [q, p].

    Choices: projected twice: once leaves in the residual rounding of the size of what is captured.
    """
    W, basis = W.double(), basis.double()
    residual = W - basis @ (basis.T @ W)
    residual = residual - basis @ (basis.T @ residual)
    return W - residual, residual


def spread(descriptors: Tensor, mask: Tensor) -> float:
    """σ_f of a scene (Eq 15): how much shape varies within its regions; about 1 in rooms, 0 where there are none.

    Args: descriptors [M, n, ...], mask [M, n] true where a member exists.
    Choices: of a region, the deviation of its members' descriptors, rms over channels (the printed ‖σ‖ / √Q); mean over
      regions that have members. Descriptors are not standardised: they have no unit, and a scene's own constants
      would make a flat scene as rich as any.
    """
    values, there = descriptors.double().flatten(2), mask[..., None].double()
    count = there.sum(1).clamp_min(1)
    rest = (values - (values * there).sum(1, keepdim=True) / count[:, None]) * there
    deviations = (rest.square().sum(1) / count).mean(-1).sqrt()[mask.any(1)]
    return float(deviations.mean()) if deviations.numel() else 0.0


@dataclass(frozen=True)
class Growth:
    """Limits and rules of a basis' growth.

    energy:    fraction of energy to reach: of captured + residual (`total`), or of the residual alone (the printed
               rule, which always adds a vector).
    tolerance: ρ or ρ′ below which the scene is no news and nothing is added (ε = 0.2).
    max_rank:  ceiling of r as a fraction of q, below 1: at r = q the regulariser would vanish for ever.
    max_added: columns that a scene may add, as a fraction of those left below the ceiling; one at least.
    n_scenes:  the first so many scenes can each add a column where the ceiling is as high: of more than n_scenes - 1
               columns left, a scene leaves n_scenes - 1.
    novelty:   1 + κ σ_f of the scene: ρ′ = ρ × novelty.
    update_rule: what is compared with the tolerance: ρ (`residual`), or ρ′ (`printed`).
    Raises: ValueError on a rule or a fraction that does not exist.
    """

    energy: float = 0.96
    tolerance: float = 0.2
    max_rank: float = 0.875
    max_added: float = 0.25
    n_scenes: int = 20
    rule: str = "total"
    novelty: float = 1.0
    update_rule: str = "residual"

    def __post_init__(self) -> None:
        if not (0 < self.energy <= 1 and 0 < self.max_rank < 1 and 0 < self.max_added <= 1):
            raise ValueError(
                f"energy {self.energy}, max_added {self.max_added} or max_rank {self.max_rank} is not within (0, 1], "
                "or is 1"
            )
        if self.n_scenes < 1:
            raise ValueError(f"n_scenes {self.n_scenes} is below 1")
        if not 1 <= self.novelty < math.inf:
            raise ValueError(f"novelty {self.novelty} is below 1, or not finite")
        if self.rule not in ("total", "residual") or self.update_rule not in ("residual", "printed"):
            raise ValueError(
                f"rule {self.rule!r} is neither 'total' nor 'residual', or {self.update_rule!r} not 'printed' either"
            )


DEFAULT = Growth()


def update(basis: Tensor | None, W: Tensor, growth: Growth = DEFAULT) -> tuple[Tensor, dict[str, Any]]:
    """Extend a basis by what it misses of W (Eq 15).

    Args:
      basis:     [q, r] orthonormal to 1e-4, or None before the first scene.
      W:         [q, p] linear map of the new scene.
    Returns: basis [q, r'] float32 with BᵀB = I to 3e-8 (dense columns, q ≥ 32; one ulp else); the given columns
      come first, untouched. Report: `rank_before`, `rank_after`, `added`; `rho` and `rho_after`, the residual
      relative to W, before and after; `rho_printed`, ρ′; `energy`, the fraction of ‖W‖² captured after.
    Raises:  ValueError on values that are not finite, shapes that disagree, or a basis that is not orthonormal.
    Choices: scaled by max|W|. No update if the residual is rounding, ρ ≤ 10 eps √q, nor, by `total`, if W is captured
      to `energy` already. New columns are orthogonalised twice. The first basis comes from the SVD of W. A basis beyond
      the ceiling is kept, never cut.
    """
    _check(basis, W)
    q = W.shape[0]
    given = torch.zeros(q, 0) if basis is None else basis.float()
    rank = given.shape[1]
    report: dict[str, Any] = {"rank_before": rank, "rank_after": rank, "added": 0}
    report |= {"rho": 0.0, "rho_after": 0.0, "rho_printed": 0.0, "energy": 1.0}
    largest = W.double().abs().max() if W.numel() else torch.tensor(0.0)
    if largest == 0:
        return given, report
    old, scaled = _orthonormal(given.double()), W.double() / largest
    _, residual = project(scaled, old)
    total, missed = float((scaled**2).sum()), float((residual**2).sum())
    rho = min((missed / total) ** 0.5, 1.0)
    report |= {"rho": rho, "rho_after": rho, "rho_printed": rho * growth.novelty, "energy": 1 - rho**2}
    room = int(growth.max_rank * q) - rank
    news = rho * growth.novelty if growth.update_rule == "printed" else rho
    if rho <= 10 * EPS * q**0.5 or (rank and news <= growth.tolerance) or room <= 0:
        return given, report
    vectors, values, _ = torch.linalg.svd(residual, full_matrices=False)
    gained = torch.nn.functional.pad(torch.cumsum(values**2, 0), (1, 0))  # by 0, 1, 2, ... of the vectors
    reached = (total - missed + gained) / total if growth.rule == "total" else gained / missed
    most = max(min(int(growth.max_added * room), room - growth.n_scenes + 1), 1)
    count = min(int((reached < growth.energy).sum()), most, len(values))
    if count == 0:
        return given, report
    grown = _orthonormal(torch.cat([old, vectors[:, :count]], 1))
    left = float((project(scaled, grown)[1] ** 2).sum()) / total
    report |= {"rank_after": grown.shape[1], "added": grown.shape[1] - rank}
    report |= {"rho_after": left**0.5, "energy": max(1 - left, 0.0)}
    return _rounded(grown, given), report


def _check(basis: Tensor | None, W: Tensor) -> None:
    if W.ndim != 2 or not torch.isfinite(W).all():
        raise ValueError(f"W {tuple(W.shape)} is not finite, or not a matrix")
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

    A graph of a dozen small operations a map takes twice as long; torch instead of NumPy, whose products of so
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
      first, so that 1e±25 neither overflows nor vanishes. The printed α is `Modulation`, or 1.
    """
    return basis_loss({"": W}, {"": basis})


def basis_loss(maps: dict[str, Tensor], bases: dict[str, Tensor], backend: str = "auto") -> Tensor:
    """Mean over linear maps of `regularizer`; 0 without bases (the first scene). backend: of `rasterize`."""
    if not bases:
        return torch.tensor(0.0)
    weights = [maps[name] for name in bases]
    if not is_compiled(weights[0], backend):
        return torch.stack([_outside(W, B) for W, B in zip(weights, bases.values(), strict=True)]).mean()
    loss: Tensor = _Outside.apply(list(bases.values()), *weights).mean()
    return loss


def _outside(W: Tensor, B: Tensor) -> Tensor:
    """`regularizer` by autograd, on any device: twin of `_Outside`."""
    largest = W.detach().abs().amax() if W.numel() and B.shape[1] else W.new_zeros(())
    scaled = W / torch.where(largest > 0, largest, 1)
    share = (scaled - B @ (B.T @ scaled)).square().sum() / scaled.detach().square().sum().clamp_min(1e-30)
    return torch.where(largest > 0, share, 0)


class Modulation(nn.Module):
    """α of Eq 14: softplus(w · z̄ + b) of the mean z̄ [C] of the encoded regions, within [1e-3, 10].

    Choices: taught by its own loss, α goes to 0 whatever z̄ is; no other loss sees it. So no gradient reaches w, b or
      z̄, and α stays what was drawn: 1 at z̄ = 0, a fixed function of the shapes in view. (With α L - log α it would
      learn 1 / L: finite, not in print, and the pull would be strongest where it is needed least.)
    """

    def __init__(self, n_channels: int):
        super().__init__()
        with torch.random.fork_rng(devices=[]):  # what is drawn after it is drawn as it would be without it
            self.linear = nn.Linear(n_channels, 1)
        nn.init.constant_(self.linear.bias, math.log(math.e - 1))

    def forward(self, mean_encoding: Tensor) -> Tensor:
        alpha: Tensor = nn.functional.softplus(self.linear(mean_encoding.detach()))[0]
        return alpha.clamp(WEAKEST, STRONGEST).detach()
