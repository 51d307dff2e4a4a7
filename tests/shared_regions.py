"""Regions that tests share: a plain one, and the extreme ones of the method."""

import torch

from chebsplat.splats.rotations import rotation_matrices


def region(n=24, seed=0, m=3):
    """Flat clouds of random Gaussians: means, scales, rotmats, mask."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.2])
    scales = torch.rand(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.2, 0.02]) + 0.01
    rotmats = rotation_matrices(torch.randn(m, n, 4, generator=g, dtype=torch.float64))
    return means, scales, rotmats, torch.ones(m, n, dtype=torch.bool)


def turned(seed):
    """A random rotation [3, 3]."""
    g = torch.Generator().manual_seed(seed)
    return rotation_matrices(torch.randn(1, 4, generator=g, dtype=torch.float64))[0]


def _lattice(m, sides):
    place = torch.cartesian_prod(*(torch.arange(k, dtype=torch.float64) for k in sides))
    place = torch.nn.functional.pad(place, (0, 3 - len(sides)))
    return place[torch.arange(m.shape[1]) % len(place)].expand_as(m).contiguous()


def _mixed(s):
    g = torch.Generator().manual_seed(9)
    return s * 10.0 ** (12 * torch.rand(s.shape, generator=g, dtype=torch.float64) - 6)


def _case(change):
    return lambda m, s, r, mask: (*change(m, s), r, mask)


CASES = {
    "coincident": _case(lambda m, s: (m * 0, s)),
    "collinear": _case(lambda m, s: (m * torch.tensor([1.0, 0, 0]), s)),
    "coplanar": _case(lambda m, s: (m * torch.tensor([1.0, 1, 0]), s)),
    "square lattice": _case(lambda m, s: (_lattice(m, (8, 8)), s * 0 + 0.5)),
    "cubic lattice": _case(lambda m, s: (_lattice(m, (4, 4, 4)), s * 0 + 0.5)),
    "all scales zero": _case(lambda m, s: (m, s * 0)),
    "needles": _case(lambda m, s: (m, s * torch.tensor([1e6, 1, 1]))),
    "pancakes with a zero axis": _case(lambda m, s: (m, s * torch.tensor([1e6, 1e6, 0]))),
    "scales from 1e-6 to 1e6": _case(lambda m, s: (m, _mixed(s))),
    "scales of 1e150": _case(lambda m, s: (m, s * 1e150)),
    "scales of 1e-150": _case(lambda m, s: (m, s * 1e-150)),
    "units of 1e150": _case(lambda m, s: (m * 1e150, s * 1e150)),
    "units of 1e-150": _case(lambda m, s: (m * 1e-150, s * 1e-150)),
    "offset of 1e6": _case(lambda m, s: (m + 1e6, s)),
    "one outlier at 1e4": _case(lambda m, s: (torch.cat([m[:, :-1], m[:, -1:] * 0 + 1e4], 1), s)),
    "one outlier at 1e8": _case(lambda m, s: (torch.cat([m[:, :-1], m[:, -1:] * 0 + 1e8], 1), s)),
    "far pairs": lambda m, s, r, mask: (
        torch.stack([3e7 * (torch.arange(m.shape[1]) // 2) ** 2.0] + [torch.zeros(m.shape[1])] * 2, -1)
        .double()
        .expand_as(m)
        + torch.tensor([0.0, 1.0, 0.0])[None, None] * (torch.arange(m.shape[1]) % 2)[None, :, None],
        s * 0,
        r,
        mask,
    ),
}
