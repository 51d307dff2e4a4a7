"""Weights that break the printed knowledge space (Eqs 14-15; docs/method.md, section 7).

Errors of `update` are those of orthonormality, max |BᵀB − I|; a ρ outside [0, 1] or not finite is one, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.shape.cks import Growth, Modulation, regularizer, spread, update

ORTHONORMAL = 3e-8
Q = 32


def weights(q: int = Q, p: int = Q, rank: int | None = None, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    if rank is None:
        return torch.randn(q, p, generator=g)
    return torch.randn(q, rank, generator=g) @ torch.randn(rank, p, generator=g)


def off_orthonormal(basis: Tensor) -> float:
    gram = basis.detach().double().T @ basis.detach().double()
    return relative(gram, np.eye(basis.shape[1]))


SEQUENCES: dict[str, Callable[[], list[Tensor]]] = {
    "W = 0": lambda: [torch.zeros(Q, Q), weights()],
    "0 after a scene": lambda: [weights(), torch.zeros(Q, Q)],
    "entries 1e+25": lambda: [weights() * 1e25, weights(seed=1) * 1e25],
    "entries 1e-25": lambda: [weights() * 1e-25, weights(seed=1) * 1e-25],
    "entries 1e-25 to 1e+25": lambda: [weights() * 1e25, weights(seed=1) * 1e-25],
    "columns 1e-20 to 1e+15": lambda: [weights() * torch.logspace(-20, 15, Q)],
    "rank 1": lambda: [weights(rank=1), weights(rank=1, seed=1)],
    "nearly parallel columns": lambda: [weights(rank=1) + 1e-7 * weights(seed=1)] * 2,
    "residual 1e-6": lambda: [weights(rank=4), weights(rank=4) + 1e-6 * weights(seed=8)],
    "already inside": lambda: [weights(rank=4)] * 4,
    "float64 entries of 1e+300": lambda: [weights().double() * 1e300] * 2,
    "one entry": lambda: [torch.eye(Q)[:, 3:4] @ torch.eye(Q)[4:5]] * 2,
    "4 scenes of full rank": lambda: [weights(seed=s) for s in range(4)],
    "200 tiny updates": lambda: [weights(p=1, seed=s) * 1e-20 for s in range(200)],
    "200 drifts of a thousandth": lambda: [weights(rank=4) + drift(s) for s in range(200)],
}


def drift(steps: int) -> Tensor:
    return sum((1e-3 * weights(seed=100 + s) for s in range(steps)), torch.zeros(Q, Q))


@case("{name}, {rule}", name=SEQUENCES, rule=["total", "residual"])
def sequence(name: str, rule: str) -> Outcome:
    """Raises ValueError on an impossible report."""
    basis, error = None, 0.0
    for W in SEQUENCES[name]():
        basis, report = update(basis, W, Growth(rule=rule))
        if not (0 <= report["rho"] <= 1 and 0 <= report["energy"] <= 1 and report["rank_after"] < Q):
            raise ValueError(f"impossible report {report}")
        error = max(error, off_orthonormal(basis))
    return Outcome(error, ORTHONORMAL)


def warm_started(change: float) -> list[Tensor]:
    """Each scene's weights are those of the one before, moved by `change` of their norm."""
    scenes = [weights()]
    for seed in range(1, 20):
        moved = weights(seed=seed)
        scenes.append(scenes[-1] + change * scenes[-1].norm() / moved.norm() * moved)
    return scenes


def of_rank_8(shared: int) -> list[Tensor]:
    core = weights(p=shared)
    return [torch.cat([core, weights(p=8 - shared, seed=s)], 1) @ weights(8, seed=100 + s) for s in range(1, 21)]


TWENTY: dict[str, Callable[[], list[Tensor]]] = {
    "0 of 8 directions shared": lambda: of_rank_8(0),
    "6 of 8 directions shared": lambda: of_rank_8(6),
    "full rank, nothing shared": lambda: [weights(seed=s) for s in range(20)],
    "each 0.3 from the last": lambda: warm_started(0.3),
    "each 0.6 from the last": lambda: warm_started(0.6),
}


@case("20 scenes, {name}", name=TWENTY)
def growth(name: str) -> Outcome:
    """Rank over 20 revisions: each scene of news adds a column, and it stays below q: ρ is never 0 for ever."""
    basis, rhos, ranks, error = None, [], [], 0.0
    scenes = TWENTY[name]()
    for W in scenes:
        basis, report = update(basis, W)
        rhos.append(report["rho"])
        ranks.append(report["rank_after"])
        error = max(error, off_orthonormal(basis))
    news = [after > before for before, after in zip([0, *ranks], ranks, strict=False)]
    wanted = [rho > 0.2 for rho in rhos]
    if not (news == wanted and ranks[0] < ranks[-1] < Q and all(0 < rho <= 1 for rho in rhos)):
        raise ValueError(f"ranks {ranks}, rho {rhos}")
    return Outcome(error, ORTHONORMAL)


ALIKE = ["all alike", "of no region", "of empty regions", "of one Gaussian a region"]


@case("descriptors {name}", name=[*ALIKE, "1e+20", "1e-20"])
def spread_of_descriptors(name: str) -> Outcome:
    """σ_f against float64 in units of its own, and an update by ρ′ of it."""
    size = {"1e+20": 1e20, "1e-20": 1e-20}.get(name, 1.0)
    values = torch.randn(6, 9, 14, generator=torch.Generator().manual_seed(0)) * size
    mask = torch.ones(6, 9, dtype=torch.bool)
    if name == "all alike":
        values = torch.full_like(values, 4.7)
    elif name == "of no region":
        values, mask = values[:0], mask[:0]
    elif name == "of empty regions":
        mask[:] = False
    elif name == "of one Gaussian a region":
        mask[:, 1:] = False
    found = spread(values * mask[..., None], mask)
    exact = float((values.double() / size).var(1, unbiased=False).mean(-1).sqrt().mean()) if size != 1 else 0.0
    basis, _ = update(None, weights(rank=4))
    _, report = update(basis, weights(seed=1), Growth(novelty=1 + found, update_rule="printed"))
    if not (math.isfinite(report["rho_printed"]) and report["rho_printed"] >= report["rho"]):
        raise ValueError(f"impossible report {report}")
    return Outcome(abs(found / size - exact), 1e-6)


@case("modulation at {size:.0e}", size=[0.0, 1e-20, 1e20, -1e20])
def modulation(size: float) -> Outcome:
    """α against softplus in float64, and the loss behind it."""
    torch.manual_seed(0)
    network, W = Modulation(8), weights().requires_grad_(True)
    mean = size * network.linear.weight[0].detach().sign()
    alpha = network(mean)
    (alpha * regularizer(W, torch.eye(Q)[:, :4])).backward()
    if not torch.isfinite(W.grad).all() or network.linear.weight.grad is not None:
        raise ValueError("its gradient is not finite, or teaches the network")
    weight, bias = (value.detach().double() for value in network.linear.parameters())
    x = float((weight[0] * mean.double()).sum() + bias[0])
    exact = min(max(x if x > 30 else math.log1p(math.exp(x)), 1e-3), 10.0)
    return Outcome(abs(alpha.item() / exact - 1), 1e-6)


@case("the size of a residual of {size:.0e}", size=[1e-3, 1e-6, 1e-12])
def residual_size(size: float) -> Outcome:
    """ρ against 60 digits, relative to itself."""
    basis, _ = update(None, weights(rank=4), Growth(energy=0.999999))
    inside = torch.linalg.qr(basis.double())[0] @ weights(basis.shape[1], Q, seed=1).double()
    W = inside + size * weights(seed=8).double()
    with mpmath.workdps(60):
        B, M = (mpmath.matrix(v.double().tolist()) for v in (basis, W))
        Y = mpmath.qr(B, mode="skinny")[0]
        rest = M - Y * (Y.T * M)
        exact = float(mpmath.norm(rest) / mpmath.norm(M))
    rho = update(basis, W)[1]["rho"]
    # float64 rounds W itself by 1e-16, so a residual of 1e-12 is known to 1e-4.
    return Outcome(abs(rho / exact - 1), max(1e-9, 1e-15 / size))


@case("regulariser of entries {size:.0e}", size=[0.0, 1e-25, 1.0, 1e25])
def regulariser(size: float) -> Outcome:
    """Its value, and its gradient in units of its largest."""
    basis, _ = update(None, weights(rank=6))
    W = (weights(seed=3) * size).requires_grad_(True)
    value = regularizer(W, basis)
    (slope,) = torch.autograd.grad(value, W)
    if not torch.isfinite(slope).all():
        raise ValueError("its gradient is not finite")
    exact, off = 0.0, 0.0
    if size:
        B, M = basis.double(), W.detach().double() / size
        rest, total = M - B @ (B.T @ M), M.square().sum()
        exact = float(rest.square().sum() / total)
        off = relative(slope.double() * size, 2 * rest / total)
    return Outcome(max(abs(value.item() - exact), off), 1e-6)
