"""Regions that tests share: plain ones, and the extreme ones of the stability suite."""

import torch

from benchmarks.stability.descriptor import REGIONS
from chebsplat.shape.described import Descriptor
from chebsplat.shape.descriptor import describe
from chebsplat.splats.rotations import rotation_matrices


def region(n=24, seed=0, m=3):
    """Flat clouds of random Gaussians: means, scales, rotmats, mask."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.2])
    scales = (
        torch.rand(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.2, 0.02])
        + 0.01
    )
    rotmats = rotation_matrices(torch.randn(m, n, 4, generator=g, dtype=torch.float64))
    return means, scales, rotmats, torch.ones(m, n, dtype=torch.bool)


def extreme(name):
    """One region of the stability suite: means, scales, rotmats, mask."""
    values = [torch.from_numpy(value)[None] for value in REGIONS[name]()]
    return *values, torch.ones(values[0].shape[:2], dtype=torch.bool)


def turned(seed):
    """A random rotation [3, 3]."""
    g = torch.Generator().manual_seed(seed)
    return rotation_matrices(torch.randn(1, 4, generator=g, dtype=torch.float64))[0]


def descriptor_of(*regions, dtype=None, backend="auto", **numbers):
    """`describe` with the numbers of its `Descriptor` by name."""
    return describe(*regions, Descriptor(**numbers), dtype=dtype, backend=backend)
