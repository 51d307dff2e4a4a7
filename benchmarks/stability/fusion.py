"""Points and regions that break the printed propagation (Eq 8; docs/method.md, section 4).

Errors are those of the weights.
"""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.shape.fusion import LEAST, propagation_weights, share_undefined
from chebsplat.splats.rotations import rotation_matrices

TOLERANCE = 1e-5  # logits reach 16, and float32 rounds each to 1e-6; where they are larger one region takes all
UNDERFLOWS = 87.0, 104.0  # -logits between which exp in float32 goes to 0, by the processor's mode
N_POINTS, N_REGIONS = 60, 12


def room(scale: Any = (0.3, 0.3, 0.03), units: float = 1.0, offset: float = 0.0) -> tuple[Any, ...]:
    """Arguments of `propagation_weights`: points and regions in a unit box; a region covers what its radius reaches."""
    g = torch.Generator().manual_seed(0)
    means, centers = torch.rand(N_POINTS, 3, generator=g), torch.rand(N_REGIONS, 3, generator=g)
    rotmats = rotation_matrices(torch.randn(N_REGIONS, 4, generator=g))
    scales = torch.tensor(scale, dtype=torch.float64).expand(N_REGIONS, 3) * 0.1 * units
    distance = torch.cdist(means, centers)
    cover = torch.where(distance < 0.5, torch.arange(N_REGIONS), -1)
    places = ((v.double() * units + offset).float() for v in (means, centers))
    means, centers = places
    return means, cover, centers, rotmats, scales.float(), 0.5 * units


def exact_weights(
    means: Tensor, cover: Tensor, centers: Tensor, rotmats: Tensor, scales: Tensor, radius: float,
    temperature: float = 1.0, inflation: float = 0.25,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The documented weights in 60 digits, and of each point the least -logit of a region that covers it, else inf."""
    mp = np.frompyfunc(mpmath.mpf, 1, 1)
    with mpmath.workdps(60):
        p, c, R, s = (mp(v.double().numpy()) for v in (means, centers, rotmats, scales))
        local = ((p[:, None] - c)[:, :, None, :] @ R[None])[:, :, 0] / mpmath.mpf(radius)
        variances = np.maximum((s / mpmath.mpf(radius)) ** 2 + mpmath.mpf(inflation) ** 2, mpmath.mpf(LEAST))
        lengths = np.where(cover.numpy() >= 0, (local**2 / variances).sum(-1) / temperature, mpmath.inf)
        least = lengths.min(1)
        shifted = lengths - np.where(least < mpmath.inf, least, mpmath.mpf(0))[:, None]
        weights = np.frompyfunc(mpmath.exp, 1, 1)(-shifted)
        total = weights.sum(1, keepdims=True)
        return (weights / np.where(total > 0, total, mpmath.mpf(1))).astype(np.float64), least.astype(np.float64)


def compare(arguments: tuple[Any, ...], **options: float) -> Outcome:
    """Ours against 60 digits. Raises ValueError if a gradient is not finite, or, without inflation, if other points
    than those that are 0 / 0 in print count as guarded.
    """
    means, cover, centers, rotmats, scales, radius = arguments
    inputs = [v.clone().requires_grad_(True) for v in (means, centers, rotmats, scales)]
    found = propagation_weights(inputs[0], cover, *inputs[1:], radius, **options)
    slopes = torch.autograd.grad(found.square().sum(), inputs)
    if not all(torch.isfinite(slope).all() for slope in slopes):
        raise ValueError("a gradient is not finite")

    exact, least = exact_weights(*arguments, **options)
    if options.get("inflation") == 0:
        covered, share = least[np.isfinite(least)], share_undefined(*arguments)
        surely, perhaps = ((covered > limit).mean() if len(covered) else 0.0 for limit in reversed(UNDERFLOWS))
        if not surely - 1e-6 <= share <= perhaps + 1e-6:
            raise ValueError(f"guarded {share}, not {surely} to {perhaps}")
    return Outcome(relative(found.detach(), exact), TOLERANCE)


SPLATS: dict[str, tuple[float, ...]] = {
    "round splats": (1, 1, 1),
    "flat splats": (0.3, 0.3, 0.03),
    "thin splats": (0.3, 0.3, 1e-4),
    "splats of width 1e-9": (0.3, 0.3, 1e-9),
    "needles 1e6": (1e3, 1e-3, 1e-3),
    "pancakes 1e12": (1e6, 1e6, 1e-6),
    "all scales 0": (0, 0, 0),
    "needles of no width": (1, 0, 0),
    "scales 1e-30": (1e-30,) * 3,
    "scales 1e+15": (1e15,) * 3,
}


@case("{name}", name=SPLATS)
def splats(name: str) -> Outcome:
    return compare(room(SPLATS[name]))


@case("units {units:.0e}", units=[1e-22, 1e-6, 1e6, 1e22])
def units(units: float) -> Outcome:
    return compare(room(units=units))


@case("offset {offset:.0e}", offset=[1e3, 1e6])
def offset(offset: float) -> Outcome:
    return compare(room(offset=offset))


@case("coincident centres and points")
def coincident() -> Outcome:
    means, cover, centers, *rest = room()
    return compare((means * 0, cover, centers * 0, *rest))


@case("points that nothing covers")
def uncovered() -> Outcome:
    means, cover, *rest = room()
    cover[::2] = -1
    return compare((means, cover, *rest))


@case("temperature {temperature:.0e}", temperature=[1e-9, 1e-3, 1e6])
def temperatures(temperature: float) -> Outcome:
    return compare(room(), temperature=temperature)


# as printed: a centre's own deviations, without inflation

_means, _cover, _centers, *_rest = room()
_half = torch.where(torch.arange(N_POINTS)[:, None] % 2 > 0, _cover, -1)
PRINTED: dict[str, tuple[Any, ...]] = {
    **{name: room(SPLATS[name]) for name in ("round splats", "flat splats", "splats of width 1e-9")},
    "needles of no width": room(SPLATS["needles of no width"]),
    "scales 0": room((0, 0, 0)),
    "scales 1e-20": room((1e-20,) * 3),
    "scales 1e+20": room((1e20,) * 3),
    "scales 1e-20 to 1e+20": room((1e-20, 1, 1e20)),
    "points that nothing covers": (_means, _half, _centers, *_rest),
    "coincident centres and points": (0 * _means, _cover, 0 * _centers, *_rest),
}


@case("as printed, {name}", name=PRINTED)
def as_printed(name: str) -> Outcome:
    return compare(PRINTED[name], inflation=0.0)
