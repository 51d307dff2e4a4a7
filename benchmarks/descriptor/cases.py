"""Regions that `python -m benchmarks descriptor` compares routes on, and their descriptors in 50 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import torch
from torch import Tensor

from chebsplat.shape.regions import build_regions
from chebsplat.splats.gaussians import activated, initial_gaussians, local_shape
from chebsplat.splats.rotations import rotation_matrices
from chebsplat.synthetic import layout

J, D, K = 4, 8, 16
ANISOTROPY, BANDWIDTH = 30.0, 0.7
Regions = tuple[Tensor, Tensor, Tensor, Tensor]


def regions_of(kind: str, n: int, m: int) -> Regions:
    """m regions of n Gaussians: `random` flat clouds, `room` from a generated office, `degenerate` lattices, pairs,
    lines and coincident points.
    """
    g = torch.Generator().manual_seed(0)
    means = torch.randn(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.2])
    scales = torch.rand(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.2, 0.02]) + 0.01
    rotmats = rotation_matrices(torch.randn(m * n, 4, generator=g, dtype=torch.float64)).reshape(m, n, 3, 3)
    mask = torch.ones(m, n, dtype=torch.bool)
    if kind == "room":
        points, raw = room_gaussians(20_000)
        members = torch.as_tensor(build_regions(points, 4 * m, n).members)
        members = members[(members >= 0).all(1)][:m]  # whole ones: the other routes know no mask
        index, (_, quats, scales, _) = members.clamp_min(0), activated(raw)
        rotmats = rotation_matrices(quats[index].reshape(-1, 4)).reshape(*index.shape, 3, 3).double()
        return torch.as_tensor(points)[index], scales[index].double(), rotmats, members >= 0
    if kind == "degenerate":
        place = torch.arange(n, dtype=torch.float64)
        shapes = [
            torch.stack([place % 8, place // 8 % 8, place // 64], -1),  # a lattice
            torch.stack([place // 2 * 50, place % 2, 0 * place], -1),  # pairs far apart
            torch.stack([place, 0 * place, 0 * place], -1),
            torch.zeros(n, 3, dtype=torch.float64),
        ]
        means = torch.stack([shapes[r % len(shapes)] for r in range(m)])
        scales = torch.full_like(scales, 0.3)
    return means, scales, rotmats, mask


def room_gaussians(n: int) -> tuple[np.ndarray, dict[str, Tensor]]:
    """Points [n, 3] on the surfaces of a generated office, 5 mm off, and the initial Gaussians there."""
    soup, rng = layout.build("office", 0).soup, np.random.default_rng(0)
    corners = soup.vertices[soup.triangles].astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    chosen = rng.choice(len(area), n, p=area / area.sum())
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = corners[chosen, 0] + u * sides[chosen, 0] + v * sides[chosen, 1] + 0.005 * rng.standard_normal((n, 3))
    shape, _ = local_shape(points, 16)
    return points, initial_gaussians(points, np.full((n, 3), 128, np.uint8), shape)


def mpmath_full(given: Regions, r: int) -> np.ndarray:
    """Region r's full-spectrum descriptors of the first angle, [n, D - 1], in 50 digits from the float64 input."""
    mpmath.mp.dps = 50
    means, scales, rotmats = (x[r].numpy() for x in given[:3])
    keep = np.flatnonzero(given[3][r].numpy())
    n = len(keep)
    centres = [[mpmath.mpf(float(v)) for v in means[i]] for i in keep]
    mean = [sum(c[k] for c in centres) / n for k in range(3)]
    centres = [[c[k] - mean[k] for k in range(3)] for c in centres]
    radius = mpmath.sqrt(sum(v * v for c in centres for v in c) / n) or mpmath.mpf(1)
    typical = sorted(scales[i].max() for i in keep)[(n - 1) // 2]
    Y = []
    for i in keep:
        roots = [1 / mpmath.sqrt(1 + ANISOTROPY * (mpmath.mpf(float(s)) / float(typical)) ** 2) for s in scales[i]]
        Y.append([[roots[k] * float(rotmats[i][a, k]) for a in range(3)] for k in range(3)])
    W = mpmath.zeros(n)
    for i in range(n):
        for j in range(i):
            delta = [(centres[i][k] - centres[j][k]) / radius for k in range(3)]
            total = sum(sum(row[a] * delta[a] for a in range(3)) ** 2 for side in (i, j) for row in Y[side])
            W[i, j] = W[j, i] = mpmath.exp(-total / (2 * mpmath.mpf(BANDWIDTH) ** 2))
    root = [mpmath.sqrt(sum(W[i, j] for j in range(n))) for i in range(n)]
    x = mpmath.matrix(n)
    for i in range(n):
        for j in range(n):
            x[i, j] = -W[i, j] / (root[i] * root[j])
    terms = [mpmath.eye(n), x]
    for _ in range(D // 2 - 1):
        terms.append(2 * x * terms[-1] - terms[-2])
    out = np.zeros((given[0].shape[1], D - 1))
    for d in range(2, D + 1):
        m, k = d // 2, d - d // 2
        for i in range(n):
            value = 2 * sum(terms[m][i, j] * terms[k][j, i] for j in range(n)) - (x[i, i] if k > m else 1)
            out[keep[i], d - 2] = n * (value - (1, 0, -1, 0)[d % 4])
    return out
