"""Values that break printed soft histograms and masks (Eqs 11-13; docs/method.md, section 5)."""

from __future__ import annotations

from collections.abc import Callable

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.rasterize import rasterize
from chebsplat.training.prune import MAX_LOGIT, apply_mask, hard_mask, soft_mask
from chebsplat.training.sh_prune import soft_histogram

N_BINS = 8
HISTOGRAM = 1e-5  # float32 rounds a value's place among 8 bins to 1e-6, and the slope is 20 / 4


def normal(n: int = 40, seed: int = 0) -> Tensor:
    return torch.randn(n, generator=torch.Generator().manual_seed(seed))


def exact_histogram(values: Tensor, low: Tensor, high: Tensor) -> np.ndarray:
    with mpmath.workdps(40):
        v = np.frompyfunc(mpmath.mpf, 1, 1)(values.double().numpy())
        width = max((mpmath.mpf(high.item()) - mpmath.mpf(low.item())) / N_BINS, mpmath.mpf("1e-6"))
        inside = (v - mpmath.mpf(low.item())) / width
        most = mpmath.mpf(10) ** 6
        below = [
            [1 / (1 + mpmath.exp(min(20 * (x - edge), most))) for edge in range(1, N_BINS)]
            for x in inside
        ]
        mass = np.diff(
            np.array([[0, *row, 1] for row in below], object).reshape(-1, N_BINS + 1), axis=1
        )
        return (mass.sum(0) / max(len(values), 1)).astype(np.float64)


VALUES: dict[str, Callable[[], Tensor]] = {
    "constant": lambda: torch.full((30,), 0.3),
    "constant at 1e6": lambda: torch.full((30,), 1e6),
    "one value": lambda: torch.tensor([0.5]),
    "spread 1": normal,
    "spread 1e-30": lambda: normal() * 1e-30,
    "spread 1e+30": lambda: normal() * 1e30,
    "spread 1 at 1e6": lambda: normal() + 1e6,
    "two values, 2e6 apart": lambda: torch.tensor([-1e6, 1e6]),
    "values beyond the bounds": lambda: torch.tensor([-9.0, 9.0, 1e30]),
    "one of 1e30 among 40": lambda: torch.cat([normal(), torch.tensor([1e30])]),
}


@case("histogram, {name}", name=VALUES)
def histogram(name: str) -> Outcome:
    """Bins against 40 digits, of which the sum is 1."""
    values = VALUES[name]()
    low, high = values.aminmax() if "beyond" not in name else (torch.tensor(0.0), torch.tensor(1.0))
    inputs = [v.clone().requires_grad_(True) for v in (values, low, high)]
    bins = soft_histogram(inputs[0], torch.ones(len(values), dtype=torch.bool), N_BINS, *inputs[1:])
    slopes = torch.autograd.grad(bins.square().sum(), inputs)
    if not all(torch.isfinite(s).all() for s in slopes):
        raise ValueError("a gradient is not finite")
    error = max(
        relative(bins.detach(), exact_histogram(values, low, high)), abs(bins.sum().item() - 1)
    )
    return Outcome(error, HISTOGRAM)


@case("histogram of {n} values among {bad}", n=[0, 12], bad=[np.nan, np.inf, 1e38])
def invalid(n: int, bad: float) -> Outcome:
    """Values that are not valid leave no trace, in histogram or gradient."""
    values = torch.cat([normal(n).clamp(-1, 1), torch.full((20,), bad)]).requires_grad_(True)
    valid, low, high = torch.arange(n + 20) < n, torch.tensor(-1.0), torch.tensor(1.0)
    bins = soft_histogram(values, valid, N_BINS, low, high)
    (slope,) = torch.autograd.grad(bins.square().sum(), values)
    if not torch.isfinite(slope).all() or (slope[n:] != 0).any():
        raise ValueError("what is not valid has a gradient")
    error = relative(bins.detach(), exact_histogram(values.detach()[:n], low, high))
    return Outcome(error, HISTOGRAM)


@case("masks of logits {size:.0e}", size=[0.0, 1.0, 17.0, 1e3, 1e30])
def masks(size: float) -> Outcome:
    """m̂ of two gates against 40 digits; hard masks are 0 or 1 and gradients finite."""
    signs = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    logits = (signs * size).requires_grad_(True)
    soft = soft_mask(logits[:, 0], logits[:, 1])
    hard = hard_mask(soft)
    (slope,) = torch.autograd.grad(hard.sum(), logits)
    if not torch.isfinite(slope).all() or not ((hard == 0) | (hard == 1)).all():
        raise ValueError("a mask is neither 0 nor 1, or a gradient is not finite")
    limit = min(size, MAX_LOGIT)
    exact = [
        float(np.prod([1 / (1 + mpmath.exp(-limit * s)) for s in row])) for row in signs.tolist()
    ]
    return Outcome(relative(soft.detach(), exact), 1e-6)


@case("a mask of 0 renders as if removed")
def masked_render() -> Outcome:
    """Image of masked Gaussians against that of the rest; log-scales get a finite gradient."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(40, 3, generator=g) * torch.tensor([2.4, 1.6, 3.0]) - torch.tensor(
        [1.2, 0.8, -1.0]
    )
    quats, log_scales = (
        torch.randn(40, 4, generator=g),
        (torch.rand(40, 3, generator=g) * 0.15 + 0.02).log(),
    )
    opacities, colors = torch.rand(40, generator=g) * 0.8 + 0.1, torch.rand(40, 3, generator=g)
    K = torch.tensor([[[35.0, 0, 20], [0, 33, 14], [0, 0, 1]]])
    camera, mask = (torch.eye(4)[None], K, 40, 28), (torch.arange(40) % 2).float()
    log_scales.requires_grad_(True)
    small, faint = apply_mask(mask, log_scales.exp(), opacities)
    image = rasterize(means, quats, small, faint, colors, *camera, backend="cpu")[0]
    (slope,) = torch.autograd.grad(image.square().sum(), log_scales)
    if not torch.isfinite(slope).all():
        raise ValueError("a gradient is not finite")
    rest = (v.detach()[mask > 0] for v in (means, quats, log_scales.exp(), opacities, colors))
    return Outcome(relative(image.detach(), rasterize(*rest, *camera, backend="cpu")[0]), 0.0)
