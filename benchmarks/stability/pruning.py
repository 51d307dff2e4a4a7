"""Colours and logits that break printed soft histograms (Eq 13) and masks (Eqs 11-12; docs/method.md, section 5)."""

from __future__ import annotations

from collections.abc import Callable

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, naive, relative
from chebsplat.training.prune import MAX_LOGIT, apply_mask, hard_mask, soft_mask
from chebsplat.training.sh_prune import soft_histogram

N_BINS = 8
HISTOGRAM = 1e-5  # float32 rounds a value's place among 8 bins to 1e-6, and the slope is 20 / 4


def normal(n: int = 40, seed: int = 0) -> Tensor:
    return torch.randn(n, generator=torch.Generator().manual_seed(seed))


def printed(values: Tensor, low: Tensor, high: Tensor, slope: float) -> Tensor:
    """Products of two logistic steps a bin, 1 / (1 + exp(-γ x)), divided by the count."""
    width = (high - low) / N_BINS
    middles = low + width * (torch.arange(N_BINS) + 0.5)
    gamma = slope if slope < 20 else slope / width
    offset = values[:, None] - middles
    rises, falls = 1 / (1 + torch.exp(-gamma * (offset + width / 2))), 1 / (1 + torch.exp(gamma * (offset - width / 2)))
    return (rises * falls).sum(0) / len(values)


def exact_histogram(values: Tensor, low: Tensor, high: Tensor) -> np.ndarray:
    with mpmath.workdps(40):
        v = np.frompyfunc(mpmath.mpf, 1, 1)(values.double().numpy())
        width = max((mpmath.mpf(high.item()) - mpmath.mpf(low.item())) / N_BINS, mpmath.mpf("1e-6"))
        inside = (v - mpmath.mpf(low.item())) / width
        below = [[1 / (1 + mpmath.exp(min(20 * (x - edge), mpmath.mpf(10) ** 6))) for edge in range(1, N_BINS)]
                 for x in inside]  # fmt: skip
        mass = np.diff(np.array([[0, *row, 1] for row in below], object).reshape(-1, N_BINS + 1), axis=1)
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
    "one of 1e30 among 40": lambda: torch.cat([normal(), torch.tensor([1e30])]),
}


@case("histogram, {name}, gamma {slope}", name=VALUES, slope=["20/width", "1"])
def histogram(name: str, slope: str) -> Outcome:
    """Bins against 40 digits, of which the sum is 1; ours has one slope, the naive has the two that are printed."""
    values = VALUES[name]()
    low, high = values.aminmax()
    inputs = [v.clone().requires_grad_(True) for v in (values, low, high)]
    found = soft_histogram(inputs[0], torch.ones(len(values), dtype=torch.bool), N_BINS, *inputs[1:])
    slopes = torch.autograd.grad(found.square().sum(), inputs)
    if not all(torch.isfinite(s).all() for s in slopes):
        raise ValueError("a gradient is not finite")

    def attempt() -> str:
        points = values.clone().requires_grad_(True)
        bins = printed(points, low, high, 20 if slope != "1" else 1)
        (grad,) = torch.autograd.grad(bins.square().sum(), points)
        bad = 100 * (1 - torch.isfinite(grad).double().mean().item())
        return f"mass {bins.sum().item():.2f}, gradient {bad:.0f} % NaN"

    error = max(relative(found.detach(), exact_histogram(values, low, high)), abs(found.sum().item() - 1))
    return Outcome(f"range {(high - low).item():.0e}", naive(attempt), error, HISTOGRAM)


@case("histogram of {n} values among {bad}", n=[0, 12], bad=[np.nan, np.inf, 1e38])
def invalid(n: int, bad: float) -> Outcome:
    """What is not valid leaves no trace, in value or gradient."""
    values = torch.cat([normal(n).clamp(-1, 1), torch.full((20,), bad)]).requires_grad_(True)
    valid, low, high = torch.arange(n + 20) < n, torch.tensor(-1.0), torch.tensor(1.0)
    found = soft_histogram(values, valid, N_BINS, low, high)
    (slope,) = torch.autograd.grad(found.square().sum(), values)
    if not torch.isfinite(slope).all() or (slope[n:] != 0).any():
        raise ValueError("what is not valid has a gradient")

    def attempt() -> str:
        bins = printed(values.detach(), low, high, 20)
        return f"mass {bins.sum().item():.2f}"

    error = relative(found.detach(), exact_histogram(values.detach()[:n], low, high))
    return Outcome("20 invalid", naive(attempt), error, HISTOGRAM)


@case("masks of logits {size:.0e}", size=[0.0, 1.0, 17.0, 1e3, 1e30])
def masks(size: float) -> Outcome:
    """m̂ of two gates against 40 digits; hard masks are 0 or 1 and gradients finite. Naive: a mask kept as log-scale."""
    signs = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    logits = (signs * size).requires_grad_(True)
    soft = soft_mask(logits[:, 0], logits[:, 1])
    hard = hard_mask(soft)
    (slope,) = torch.autograd.grad(hard.sum(), logits)
    if not torch.isfinite(slope).all() or not ((hard == 0) | (hard == 1)).all():
        raise ValueError("a mask is neither 0 nor 1, or a gradient is not finite")
    limit = min(size, MAX_LOGIT)
    exact = [float(np.prod([1 / (1 + mpmath.exp(-limit * s)) for s in row])) for row in signs.tolist()]

    def attempt() -> str:
        raw = logits.detach().clone().requires_grad_(True)
        mask = (raw.sigmoid().prod(1) > 0.1).float() + raw.sigmoid().prod(1) - raw.sigmoid().prod(1).detach()
        log_scales = mask.log()
        (grad,) = torch.autograd.grad((1 / log_scales.exp() ** 2).sum(), raw)
        return f"gradient {100 * (1 - torch.isfinite(grad).double().mean().item()):.0f} % NaN"

    return Outcome(f"logit {size:.0e}", naive(attempt), relative(soft.detach(), exact), 1e-6)


@case("a mask of 0 renders as if removed")
def masked_render() -> Outcome:
    """Image of masked Gaussians against that of the rest; stored log-scales get a finite gradient."""
    from benchmarks.stability.rasterizer import CAMERA, scene
    from chebsplat.rasterize import rasterize

    means, quats, scales, opacities, colors = scene()
    mask = (torch.arange(len(means)) % 2).float()
    log_scales = scales.log().requires_grad_(True)
    small, faint = apply_mask(mask, log_scales.exp(), opacities)
    image = rasterize(means, quats, small, faint, colors, *CAMERA, backend="cpu")[0]
    (slope,) = torch.autograd.grad(image.square().sum(), log_scales)
    if not torch.isfinite(slope).all():
        raise ValueError("a gradient is not finite")
    keep = mask > 0
    exact = rasterize(
        *(v[keep] for v in (means, quats, log_scales.detach().exp(), opacities, colors)), *CAMERA, backend="cpu"
    )[0]

    def attempt() -> str:
        stored = (log_scales.detach() + mask.log()).requires_grad_(True)
        (grad,) = torch.autograd.grad((1 / stored.exp() ** 2).sum(), stored)
        return f"gradient {100 * (1 - torch.isfinite(grad).double().mean().item()):.0f} % NaN"

    return Outcome("half of 40 masked", naive(attempt), relative(image.detach(), exact), 0.0)
