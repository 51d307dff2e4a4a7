"""Features, logits and colours that break the printed gates of pruning and SH pruning (docs/method.md, 5 and 6)."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.training.prune import MAX_FEATURE, MAX_LOGIT, PrintedGate
from chebsplat.training.sh_mask_network import BandMaskNetwork, region_histograms

N, CHANNELS = 60, 6
ROUNDING = 1e-5  # float32 sums of products before a sigmoid of slope 1/4, histograms included


def drawn(module: nn.Module) -> nn.Module:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for value in module.parameters():
            value.copy_(0.5 * torch.randn(value.shape, generator=generator))
    return module


def normal(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1))


def finite_gradients(total: Tensor, wanted: list[Tensor]) -> bool:
    return all(bool(slope.isfinite().all()) for slope in torch.autograd.grad(total, wanted))


@case("printed gate of features {size:.0e}, logits {logit:.0e}", size=[0.0, 1e-20, 1.0, 1e20], logit=[1.0, 1e30])
def pruning_gate(size: float, logit: float) -> Outcome:
    """m̂ against float64 of inputs within the documented bounds."""
    gate = drawn(PrintedGate(CHANNELS))
    assert isinstance(gate, PrintedGate)
    features, logits = size * normal(N, CHANNELS), (logit * normal(N)).requires_grad_(True)
    soft = gate(features, logits)
    if not finite_gradients(soft.sum(), [logits, *gate.parameters()]):
        raise ValueError("a gradient is not finite")
    bounded = features.double().clamp(-MAX_FEATURE, MAX_FEATURE), logits.detach().double().clamp(-MAX_LOGIT, MAX_LOGIT)
    exact = deepcopy(gate).double()(*bounded).detach()
    return Outcome(relative(soft.detach(), exact.numpy()), ROUNDING)


def inputs(**changes: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    members = torch.arange(N).reshape(6, 10)
    found: dict[str, Any] = {
        "coefficients": 0.2 * normal(N, 16, 3),
        "directions": torch.nn.functional.normalize(normal(N, 3), dim=-1),
        "members": members,
        "logits": normal(N, 3),
        "features": normal(N, CHANNELS),
        "n_bins": 8,
    }
    return found | {name: change(found[name]) for name, change in changes.items()}


def _emptied(members: Tensor) -> Tensor:
    return torch.where(torch.arange(6)[:, None] == 2, -1, members)


BANDS: dict[str, Callable[[], dict[str, Any]]] = {
    "all masks open": lambda: inputs(logits=lambda v: torch.full_like(v, 1e30)),
    "all masks shut": lambda: inputs(logits=lambda v: torch.full_like(v, -1e30)),
    "one bin": lambda: inputs() | {"n_bins": 1},
    "64 bins": lambda: inputs() | {"n_bins": 64},
    "constant colour": lambda: inputs(coefficients=lambda v: 0 * v, directions=lambda v: v[:1].expand(N, 3)),
    "colours of 1e-30": lambda: inputs(coefficients=lambda v: 1e-30 * v),
    "colours of 1e20": lambda: inputs(coefficients=lambda v: 1e20 * v),
    "an empty region": lambda: inputs(members=_emptied),
    "a region of one": lambda: inputs(members=lambda v: torch.where(torch.arange(10) == 0, v, -1)),
    "features of 0": lambda: inputs(features=lambda v: 0 * v),
    "features of 1e-20": lambda: inputs(features=lambda v: 1e-20 * v),
    "features of 1e20": lambda: inputs(features=lambda v: 1e20 * v),
}


@case("printed SH masks, {name}", name=BANDS)
def band_masks(name: str) -> Outcome:
    """δ against float64; the gradients of weights, logits and colours are finite."""
    given = BANDS[name]()
    network = drawn(BandMaskNetwork(CHANNELS, given["n_bins"]))
    coefficients, logits = given["coefficients"].clone().requires_grad_(True), given["logits"].requires_grad_(True)
    nearest = torch.arange(N) // 10

    def delta(module: nn.Module, kind: torch.dtype) -> Tensor:
        colors = coefficients.to(kind), given["directions"].to(kind)
        histograms = region_histograms(*colors, given["members"], given["n_bins"])
        found: Tensor = module(logits.to(kind), given["features"].to(kind), histograms, nearest)
        return found

    found = delta(network, torch.float32)
    if not finite_gradients(found.sum(), [coefficients, logits, *network.parameters()]):
        raise ValueError("a gradient is not finite")
    exact = delta(deepcopy(network).double(), torch.float64).detach()
    return Outcome(relative(found.detach(), exact.numpy()), ROUNDING)
