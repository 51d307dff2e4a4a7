"""Semantic-aware pruning (gates with a straight-through mask) and densification by regions (Eqs 11-12)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

MAX_LOGIT = 10.0  # beyond, the sigmoid's gradient is lost in float32
THRESHOLD = 0.1  # a Gaussian whose soft mask is below is removed
PER_GAUSSIAN = 1.6  # 3DGS's shrink of the scales of two Gaussians that replace one


class Additions(NamedTuple):
    """parents i64 [A]: whom each new Gaussian comes from. rows: raw parameters [A, ...] of the new ones.
    changed: raw parameters [A, ...] that the parents take on, by name (a parent occurs once at most).
    """

    parents: Tensor
    rows: dict[str, Tensor]
    changed: dict[str, Tensor]


class SemanticGate(nn.Module):
    """Pruning logit [N] from semantic features [N, C]; starts open at 1."""

    def __init__(self, n_channels: int):
        super().__init__()
        self.linear = nn.Linear(n_channels, 1)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, 1.0)

    def forward(self, features: Tensor) -> Tensor:
        return self.linear(features)[:, 0]


def soft_mask(render_logits: Tensor, semantic_logits: Tensor | None) -> Tensor:
    """m̂ [N] in (0, 1): the product of the rendering and the semantic gate; the first alone without semantics."""
    soft = render_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()
    return soft if semantic_logits is None else soft * semantic_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()


def hard_mask(soft: Tensor, threshold: float = THRESHOLD) -> Tensor:
    """0 or 1 by threshold, with the gradient of `soft` (straight-through)."""
    return (soft > threshold).to(soft.dtype) + soft - soft.detach()


def apply_mask(mask: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Masked scales [N, 3] and opacities [N], at render time only: what is stored never becomes log 0."""
    return scales * mask[:, None], opacities * mask


def region_gradients(gradients: Tensor, members: Tensor) -> Tensor:
    """Mean gradient [M] of each region's members (Eq 11); gradients [N], members i64 [M, n], -1 where padded."""
    present = members >= 0
    values = torch.where(present, gradients[members.clamp_min(0)], 0.0)
    return values.sum(1) / present.sum(1).clamp_min(1)


def densify(
    raw: dict[str, Tensor],
    members: Tensor,
    gradient: Tensor,
    threshold: float,
    budget: int,
    generator: torch.Generator,
    *,
    max_candidates: int = 8,
    nearest: float = 0.3,
    farthest: float = 2.0,
) -> Additions:
    """New Gaussians in the regions whose mean gradient exceeds the threshold (Eq 12).

    Args:
      raw:      raw parameters [N, ...] by name; members i64 [M, n]; gradient [M] of `region_gradients`.
      budget:   at most so many are added; the steepest regions come first.
      nearest, farthest: bounds of a candidate's distance to the nearest Gaussian, in local spacings.
    Choices: a region's candidate count is its volume in units of local spacing³ times its relative excess gradient,
      at most `max_candidates`; candidates are uniform in the ball about the region's mean. Each inherits from the
      nearest Gaussian, which is its parent once at most: both take opacity 1 − √(1 − o), so that the two composite
      to the one, and the scales of both shrink by half of classic split's factor.
    """
    from scipy.spatial import cKDTree

    means = raw["means"].double().numpy()
    chosen = torch.argsort(gradient, descending=True, stable=True)
    chosen = chosen[gradient[chosen] > threshold]
    tree = cKDTree(means)
    candidates = []
    drawn = 0
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    for region in chosen.tolist():
        inside = members[region][members[region] >= 0].numpy()
        centre = means[inside].mean(0)
        radius = float(np.linalg.norm(means[inside] - centre, axis=1).max())
        if radius == 0:
            continue
        spacing = radius / max(len(inside), 1) ** (1 / 3)
        excess = float(gradient[region]) / threshold - 1
        count = min(int(np.ceil((radius / spacing) ** 3 * min(excess, 1.0))), max_candidates)
        offsets = rng.normal(size=(count, 3))
        offsets *= (radius * rng.random((count, 1)) ** (1 / 3)) / np.linalg.norm(offsets, axis=1, keepdims=True)
        candidates.append(np.concatenate([centre + offsets, np.full((count, 1), spacing)], 1))
        drawn += count
        if drawn >= 4 * budget:
            break
    found = np.concatenate(candidates) if candidates else np.zeros((0, 4))
    distance, parents = tree.query(found[:, :3]) if len(found) else (np.zeros(0), np.zeros(0, np.int64))
    accepted = np.flatnonzero((distance >= nearest * found[:, 3]) & (distance <= farthest * found[:, 3]))
    _, once = np.unique(parents[accepted], return_index=True)
    accepted = accepted[np.sort(once)][:budget]
    parents_kept = torch.as_tensor(parents[accepted], dtype=torch.int64)
    rows = {name: value[parents_kept].clone() for name, value in raw.items()}
    rows["means"] = torch.as_tensor(found[accepted, :3], dtype=raw["means"].dtype)
    shared = {
        "logit_opacities": halved_opacity(rows["logit_opacities"]),
        "log_scales": rows["log_scales"] - 0.5 * float(np.log(PER_GAUSSIAN)),
    }
    return Additions(parents_kept, rows | shared, shared)


def clone_or_split(
    raw: dict[str, Tensor],
    gradient: Tensor,
    threshold: float,
    scale_limit: float,
    budget: int,
    generator: torch.Generator,
) -> Additions:
    """3DGS's rule, the baseline: small Gaussians with a steep gradient [N] are cloned, large ones split in two."""
    from chebsplat.rasterize.projection import rotation_matrices

    parents = torch.argsort(gradient, descending=True, stable=True)
    parents = parents[gradient[parents] > threshold][:budget]
    rows = {name: value[parents].clone() for name, value in raw.items()}
    scales = rows["log_scales"].exp()
    large = scales.amax(1) > scale_limit
    frames = rotation_matrices(rows["quats"])
    draws = torch.randn(2, *scales.shape, generator=generator) * scales
    offsets = torch.einsum("nij,knj->kni", frames, draws) * large[None, :, None]
    smaller = torch.where(large[:, None], rows["log_scales"] - float(np.log(PER_GAUSSIAN)), rows["log_scales"])
    changed = {"means": rows["means"] + offsets[0], "log_scales": smaller}
    rows |= {"means": rows["means"] + offsets[1], "log_scales": smaller}
    return Additions(parents, rows, changed)


def halved_opacity(logits: Tensor) -> Tensor:
    """Logit of 1 − √(1 − o): two Gaussians of it composite to the opacity o of one."""
    opacity = 1 - (1 - logits.sigmoid()).clamp_min(1e-12).sqrt()
    return torch.logit(opacity.clamp(1e-6, 1 - 1e-6))


def apply_additions(optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], additions: Additions) -> None:
    """Append the new rows to parameters and optimizer; their moments start at zero, as do changed parents'."""
    if len(additions.parents) == 0:
        return
    with torch.no_grad():
        for name, values in additions.changed.items():
            raw[name][additions.parents] = values
    changed = set(additions.changed)

    def grown(name: str, moment: Tensor) -> Tensor:
        if name in changed:
            moment = moment.index_fill(0, additions.parents, 0.0)
        return torch.cat([moment, torch.zeros_like(additions.rows[name])])

    _replace(optimizer, raw, {n: torch.cat([v.detach(), additions.rows[n]]) for n, v in raw.items()}, grown)


def prune_optimizer(optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], keep: Tensor) -> None:
    """Keep the rows `keep` [N] bool of parameters and optimizer moments."""
    _replace(optimizer, raw, {n: v.detach()[keep] for n, v in raw.items()}, lambda name, moment: moment[keep])


def _replace(optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], values: dict[str, Tensor], moments) -> None:  # type: ignore[no-untyped-def]
    for group in optimizer.param_groups:
        name = group.get("name")
        if name not in values:
            continue
        old = group["params"][0]
        fresh = values[name].clone().requires_grad_(True)
        state = optimizer.state.pop(old, {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key] = moments(name, state[key])
        group["params"][0] = fresh
        if state:
            optimizer.state[fresh] = state
        raw[name] = fresh
