"""Densification in regions of steep gradient (Eqs 11-12)."""

from __future__ import annotations

import math

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def mean_gradients(lengths: Tensor, pairs: tuple[Tensor, Tensor], n_regions: int) -> Tensor:
    """Mean of |grad f(q)| over each region's points, [M] (Eq 11); 0 in a region without points.

    Which gradient the print means is open: `training.printed` has both readings.
    """
    point, region = pairs
    sums = lengths.new_zeros(n_regions).index_add(0, region, lengths[point])
    counts = lengths.new_zeros(n_regions).index_add(0, region, torch.ones_like(lengths[point]))
    return sums / counts.clamp_min(1)


def candidate_counts(volumes: Tensor, n_points: Tensor, density: float, most: int) -> Tensor:
    """N_p = min(N_max, alpha_d V / N_ori) of regions, i64 [M] (Eq 12).

    Args: volumes [M], scene units^3; n_points i64 [M]; density alpha_d, 1 / scene units^3.
    Choices: rounded up; 0 for a region without points, where the print divides by zero.
    """
    exact = density * volumes / n_points.clamp_min(1)
    counts = exact.ceil().clamp(0, most).long()
    return torch.where(n_points > 0, counts, 0)


def in_ball(centers: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """A place in the ball about each centre [A, 3], uniform in its volume."""
    directions = torch.randn(centers.shape, generator=generator, dtype=centers.dtype)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    lengths = torch.rand(len(centers), 1, generator=generator, dtype=centers.dtype) ** (1 / 3)
    return centers + radius * lengths * directions


def ball_volume(radius: float) -> float:
    """4/3 pi r^3: V_pc of a region, whose form the print does not name."""
    return 4 / 3 * math.pi * radius**3


def accepted(
    candidates: Tensor, points: Tensor, nearest: float, farthest: float
) -> tuple[Tensor, Tensor]:
    """Mask [A] of the candidates [A, 3] to keep, and the points i64 [A] that they inherit from.

    Kept are those whose nearest point [N, 3] lies between `nearest` and `farthest` away.
    """
    if len(points) == 0 or len(candidates) == 0:
        return torch.zeros(len(candidates), dtype=torch.bool), torch.zeros(len(candidates)).long()
    distance, neighbours = cKDTree(points.double().numpy()).query(candidates.double().numpy())
    apart = torch.from_numpy(distance)
    return (apart >= nearest) & (apart <= farthest), torch.from_numpy(neighbours).long()
