"""Scenes that break PE(c_i), the printed encoding of a Gaussian's own centre (Eq 7; docs/method.md, section 3).

Errors are those of the centres in units of the scene, relative to the largest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.shape.region_inputs import FARTHEST, in_scene

N = 600
TOLERANCE = 1e-6


def box() -> np.ndarray:
    return np.random.default_rng(0).random((N, 3)).astype(np.float32)


def with_one_at(means: np.ndarray, distance: float) -> np.ndarray:
    means[-1] = distance
    return means


SCENES: dict[str, Callable[[], np.ndarray]] = {
    "extent 0": lambda: np.full((N, 3), 0.3, np.float32),
    "extent 0, but one at 1e20": lambda: with_one_at(np.full((N, 3), 0.3, np.float32), 1e20),
    "extent 1e-20": lambda: np.float32(1e-20) * box(),
    "extent 1e20": lambda: np.float32(1e20) * box(),
    "one at 1e20": lambda: with_one_at(box(), 1e20),
    "one at 1e38": lambda: with_one_at(box(), 1e38),
    "extent 1 at 1e6": lambda: box() + np.float32(1e6),
    "a plane": lambda: box() * np.float32([1, 1, 0]),
    "one Gaussian": lambda: box()[:1],
}


def finite(positions: np.ndarray) -> float:
    """Share of the encodings of regions of 10, and of their gradients, that is finite."""
    torch.manual_seed(0)
    encoder = RegionEncoder(0, 4, n_layers=1)
    regions = torch.from_numpy(positions)[: len(positions) // 10 * 10 or 1]
    regions = regions.reshape(-1, min(10, len(regions)), 3)
    encoded = encoder(regions[..., :0], regions, torch.ones(regions.shape[:2], dtype=torch.bool))
    slopes = torch.autograd.grad(encoded.square().sum(), list(encoder.parameters()), allow_unused=True)
    values = torch.cat([encoded.flatten(), *(slope.flatten() for slope in slopes if slope is not None)])
    return float(values.isfinite().double().mean())


@case("position center, {name}", name=SCENES)
def position(name: str) -> Outcome:
    """Raises ValueError if what the encoder makes of it is not finite."""
    means = SCENES[name]()
    found = in_scene(means)
    if finite(found) < 1:
        raise ValueError("an encoding, or a gradient, is not finite")
    away = means.astype(np.longdouble) - np.median(means, axis=0)
    extent = np.quantile(np.abs(away).max(1).astype(np.float64), 0.95)
    exact = np.clip(away / max(extent, 1e-12), -FARTHEST, FARTHEST)
    return Outcome(relative(found, exact), TOLERANCE)
