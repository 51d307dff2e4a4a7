"""Densification: new Gaussians in regions of steep gradient (Eqs 11-12), and 3DGS's own rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from chebsplat.splats.rotations import rotation_matrices

SHRINK = 1.6  # 3DGS's divisor of the scales of two Gaussians that replace one


class Additions(NamedTuple):
    """parents i64 [A]: whom each new Gaussian comes from. rows: raw parameters [A, ...] of the new
    ones. changed: raw parameters [A, ...] that the parents take on, by name (a parent occurs once
    at most).
    """

    parents: Tensor
    rows: dict[str, Tensor]
    changed: dict[str, Tensor]


def region_gradients(gradients: Tensor, members: Tensor) -> Tensor:
    """Mean gradient [M] of regions' members i64 [M, n], -1: padding (Eq 11); gradients [N]."""
    present = members >= 0
    if not present.any():
        return gradients.new_zeros(len(members))
    values = torch.where(present, gradients[members.clamp_min(0)], 0.0)
    return values.sum(1) / present.sum(1).clamp_min(1)


@dataclass(frozen=True)
class Candidates:
    """Number of places drawn for new Gaussians, and bounds of those that are kept.

    density:  a local spacing³ (α of Eq 12); max_candidates: of a region.
    nearest, farthest: bounds of the distance to the nearest Gaussian, in local spacings.
    Raises: ValueError on bounds that are not positive and in order.
    """

    density: float = 0.05
    max_candidates: int = 32
    nearest: float = 0.5
    farthest: float = 1.5

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ValueError(f"0 < nearest {self.nearest} < farthest {self.farthest} does not hold")


DEFAULT = Candidates()


def densify(
    raw: dict[str, Tensor],
    members: Tensor,
    gradient: Tensor,
    threshold: float,
    budget: int,
    generator: torch.Generator,
    candidates: Candidates = DEFAULT,
) -> Additions:
    """New Gaussians in the regions whose mean gradient exceeds the threshold (Eq 12).

    Args:
      raw:      raw parameters [N, ...] by name; members i64 [M, n]; gradient [M] of
        `region_gradients`.
      budget:   at most so many are added; the steepest regions come first.
    Raises:  ValueError on a threshold that is not positive.
    Choices: local spacing is the median over the members of the mean distance to the three nearest
      Gaussians, members or not. A region of radius ρ gets density · 4/3 π (ρ / spacing)³ ·
      min(gradient / threshold − 1, 1) candidates, rounded up, uniform in the ball about its
      members' mean; new ones also keep `nearest` spacings apart. Each inherits from the nearest
      Gaussian, which is its parent once at most, and both change so that the two render like the
      one (`shared_opacity`, `shared_scales`). Gaussians with non-finite means are left out.
      Neighbours are searched for on the CPU, wherever the Gaussians are.
    """
    if not threshold > 0:
        raise ValueError(f"threshold {threshold} is not positive")
    gradient, members, places = gradient.cpu(), members.cpu(), raw["means"].detach().cpu()
    alive = torch.isfinite(places).all(1).numpy()
    order = torch.argsort(gradient, descending=True, stable=True)
    steep = order[gradient[order] > threshold]
    positions, index = np.zeros((0, 3)), np.zeros(0, np.int64)
    if budget > 0 and len(steep) and alive.sum() > 3:
        means, ids = places.double().numpy()[alive], np.flatnonzero(alive)
        excess = (gradient[steep].double() / threshold - 1).numpy()
        inside = np.where(alive, np.cumsum(alive) - 1, -1)[members[steep].clamp_min(0).numpy()]
        inside[members[steep].numpy() < 0] = -1
        seed = int(torch.randint(2**62, (1,), generator=generator))
        positions, parents = _places(
            means, inside, excess, budget, np.random.default_rng(seed), candidates
        )
        index = ids[parents]
    parent = torch.from_numpy(index).to(raw["means"].device)
    rows = {name: value.detach()[parent] for name, value in raw.items()}
    offsets = torch.from_numpy(positions).to(rows["means"]) - rows["means"]
    changed = {
        "logit_opacities": shared_opacity(
            rows["logit_opacities"], rows["log_scales"], rows["quats"], offsets
        ),
        "log_scales": shared_scales(rows["log_scales"], rows["quats"], offsets),
    }
    return Additions(parent, rows | changed | {"means": rows["means"] + offsets}, changed)


def _places(
    means: np.ndarray,
    inside: np.ndarray,
    excess: np.ndarray,
    budget: int,
    rng: np.random.Generator,
    candidates: Candidates,
) -> tuple[np.ndarray, np.ndarray]:
    """Places [A, 3] of new Gaussians in regions of members [R, n] (-1 where padded), steepest
    first, and the Gaussians [A] that they come from. Args: excess [R]: of the gradient over the
    threshold.
    """
    tree = cKDTree(means)
    centers, radii, spacings = _balls(tree, means, inside)
    volume = 4 / 3 * np.pi * (radii / np.where(spacings > 0, spacings, np.inf)) ** 3
    excess = np.minimum(excess, 1)
    counts = np.ceil(
        np.minimum(candidates.density * volume * excess, candidates.max_candidates)
    ).astype(np.int64)
    counts[np.cumsum(counts) - counts >= 16 * budget] = 0
    region = np.repeat(np.arange(len(counts)), counts)
    positions = centers[region] + radii[region, None] * _in_unit_ball(rng, len(region))
    distance, parents = tree.query(positions)
    spacing = spacings[region]
    rows = np.flatnonzero(
        (distance >= candidates.nearest * spacing) & (distance <= candidates.farthest * spacing)
    )
    rows = rows[np.sort(np.unique(parents[rows], return_index=True)[1])]
    rows = rows[_apart(positions[rows], candidates.nearest * spacing[rows])][:budget]
    return positions[rows], parents[rows]


def _balls(
    tree: cKDTree, means: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [R, 3], radii [R], local spacings [R] of regions of members [R, n], -1: padding."""
    present = inside >= 0
    where = np.where(present[..., None], means[inside], np.nan)
    empty = ~present.any(1)
    where[empty] = 0.0
    centers = np.nanmean(where, 1)
    radii = np.sqrt(np.nanmax(((where - centers[:, None]) ** 2).sum(-1), 1))
    used = np.unique(inside[present])
    typical = np.zeros(len(means))
    typical[used] = tree.query(means[used], 4)[0][:, 1:].mean(1)
    spacings = np.where(present, typical[inside], np.nan)
    spacings[empty] = 0.0
    return centers, radii, np.nanmedian(spacings, 1)


def _in_unit_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    directions = rng.normal(size=(count, 3))
    points: np.ndarray = directions * (
        rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(directions, axis=1, keepdims=True)
    )
    return points


def _apart(positions: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Mask [A] of the positions [A] with no earlier one nearer than `least` [A]."""
    keep = np.ones(len(positions), bool)
    if len(positions) > 1:
        pairs = cKDTree(positions).query_pairs(least.max(), output_type="ndarray")
        gap = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
        keep[pairs[gap < least[pairs[:, 1]], 1]] = False
    return keep


def shared_opacity(logits: Tensor, log_scales: Tensor, quats: Tensor, offsets: Tensor) -> Tensor:
    """Logits [A] of the opacity o' that a Gaussian and its copy, `offsets` [A, 3] away, both take
    on.

    Choices: the opacity o at the old centre stays: o = 1 − (1 − o')(1 − κ o'), where κ = exp(−½
      |S⁻¹Rᵀoffset|²) is the copy's falloff there. So 1 − √(1 − o) for a copy in place, and o for
      one too far to be seen at the centre.
    """
    local = torch.einsum("nji,nj->ni", rotation_matrices(quats), offsets)
    kappa = (
        (-0.5 * (local * torch.exp(-log_scales)).square().sum(-1))
        .nan_to_num(0.0, neginf=-1e3)
        .exp()
    )
    opacity = logits.sigmoid()
    root = ((1 + kappa) ** 2 - 4 * kappa * opacity).clamp_min(0).sqrt()
    return torch.logit((2 * opacity / (1 + kappa + root)).clamp(1e-6, 1 - 1e-6))


def shared_scales(log_scales: Tensor, quats: Tensor, offsets: Tensor) -> Tensor:
    """Log scales [A, 3] that a Gaussian and its copy, `offsets` [A, 3] away, both take on.

    Choices: the two equal Gaussians keep the one's second moment along each of its axes: s'² = s² −
      (Rᵀoffset)² / 4, at least s / 1.6 (classic split's factor). Axes across which the copy was not
      moved keep their size.
    """
    local = torch.einsum("nji,nj->ni", rotation_matrices(quats), offsets)
    relative = (1 - 0.25 * (local * torch.exp(-log_scales)).square()).nan_to_num(0.0)
    return log_scales + 0.5 * relative.clamp_min(SHRINK**-2).log()


def classic_candidates(
    raw: dict[str, Tensor], gradients: Tensor, threshold: float, scale_limit: float
) -> tuple[Tensor, Tensor]:
    """3DGS's choice by a Gaussian's own gradient [N]: those to clone and those to split, i64, the
    steepest first.

    Args: scale_limit: scene units; a Gaussian with a larger scale is split, any other one cloned.
    """
    order = torch.argsort(gradients, descending=True, stable=True)
    steep = order[(gradients > threshold)[order] & torch.isfinite(raw["means"]).all(1)[order]]
    large = raw["log_scales"][steep].exp().amax(1) > scale_limit
    return steep[~large], steep[large]


def clone_or_split(
    raw: dict[str, Tensor],
    gradients: Tensor,
    threshold: float,
    scale_limit: float,
    budget: int,
    generator: torch.Generator,
) -> Additions:
    """3DGS's rule, the baseline: small Gaussians with a steep gradient [N] are cloned, large ones
    split in two.

    Choices: the steepest come first where the budget does not suffice. A clone is the same Gaussian
      again; the two halves of a split are drawn from it, with scales divided by 1.6 and the opacity
      unchanged, as 3DGS does.
    """
    clones, splits = classic_candidates(raw, gradients, threshold, scale_limit)
    parents = torch.cat([clones, splits])
    first = torch.argsort(gradients[parents], descending=True, stable=True)[: max(budget, 0)]
    parents, large = parents[first], first >= len(clones)
    rows = {name: value.detach()[parents] for name, value in raw.items()}
    draws = (
        torch.randn(2, *rows["log_scales"].shape, generator=generator).to(parents.device)
        * rows["log_scales"].exp()
    )
    offsets = torch.einsum("nij,knj->kni", rotation_matrices(rows["quats"]), draws)
    offsets = torch.where(large[:, None], offsets, 0.0)
    smaller = torch.where(
        large[:, None], rows["log_scales"] - float(np.log(SHRINK)), rows["log_scales"]
    )
    changed = {"means": rows["means"] + offsets[0], "log_scales": smaller}
    return Additions(
        parents, rows | {"means": rows["means"] + offsets[1], "log_scales": smaller}, changed
    )
