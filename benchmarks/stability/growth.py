"""Regions that break the count of new Gaussians (Eq 12; docs/method.md, section 5).

The error is the share of new values that are not finite, or 1 if a new Gaussian lies outside its
region's ball or more came than a region may have.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from benchmarks.stability.case import Outcome, case
from chebsplat.training.densify import Candidates, densify

N, MOST = 120, 32


class Growing(NamedTuple):
    """A region of half the Gaussians, in a box of `unit`; gradient: times the threshold."""

    unit: float
    gradient: float = 2.5
    grows: bool = True


REGIONS: dict[str, Growing] = {
    "no volume": Growing(0.0, grows=False),
    "no volume, gradient 1e30": Growing(0.0, 1e30, grows=False),
    "no volume, gradient infinite": Growing(0.0, math.inf, grows=False),
    "volume 1e-60": Growing(1e-20),
    "volume 1e-60, gradient infinite": Growing(1e-20, math.inf),
    "volume 1": Growing(1.0),
    "volume 1, gradient infinite": Growing(1.0, math.inf),
    "volume 1, gradient at the threshold": Growing(1.0, 1.0, grows=False),
    "volume 1, gradient just above": Growing(1.0, 1.0 + 2e-7),
    "volume 1e60": Growing(1e20),
    "volume 1e111": Growing(1e37),
}


@case("Eq 12, {name}", name=REGIONS)
def count(name: str) -> Outcome:
    """Raises ValueError where no Gaussian came and some should, or the reverse."""
    region = REGIONS[name]
    g = torch.Generator().manual_seed(0)
    raw = {
        "means": region.unit * torch.rand(N, 3, generator=g),
        "quats": torch.randn(N, 4, generator=g),
    }
    size = math.log(0.05 * region.unit) if region.unit else -3.0
    raw |= {"log_scales": torch.full((N, 3), size), "logit_opacities": torch.zeros(N)}
    members, gradient = torch.arange(N).reshape(2, -1), torch.tensor([region.gradient, 0.5])
    options = {"density": 10, "max_candidates": MOST, "nearest": 1e-3, "farthest": 1e3}
    added = densify(
        raw, members, gradient, 1.0, 10_000, torch.Generator().manual_seed(1), Candidates(**options)
    )
    if bool(len(added.parents)) != region.grows:
        raise ValueError(f"{len(added.parents)} new Gaussians")
    inside = raw["means"][members[0]].double()
    radius = float((inside - inside.mean(0)).norm(dim=1).max())
    away = (added.rows["means"].double() - inside.mean(0)).norm(dim=1)
    values = torch.cat(
        [value.flatten() for value in (*added.rows.values(), *added.changed.values())]
    )
    error = float(1 - values.isfinite().double().mean()) if len(values) else 0.0
    if len(away) > MOST or bool((away > radius * (1 + 1e-5)).any()):
        error = 1.0
    return Outcome(error, 0.0)
