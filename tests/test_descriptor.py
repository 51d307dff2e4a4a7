"""The descriptor is exact, ignores pose, size, order and signs, and survives every degenerate region."""

import pytest
import torch
from shared_regions import region

from chebsplat.shape import descriptor
from chebsplat.shape.descriptor_reference import chebyshev_diagonals
from chebsplat.splats.rotations import rotation_matrices


def describe(given, **options):
    return descriptor.describe(*given, **({"dtype": torch.float64} | options)).values


def close(a, b, tolerance):
    assert ((a - b).abs().amax() / b.abs().amax()) <= tolerance


def rotation(seed=5):
    return rotation_matrices(torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)[None])[
        0
    ]


@pytest.mark.parametrize("degree", range(2, 13))
def test_recurrence_equals_the_eigendecomposition(degree):
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(20, 20, generator=g, dtype=torch.float64)
    weights = (weights + weights.T).fill_diagonal_(0)
    root = weights.sum(1).rsqrt()
    S = root[:, None] * weights * root
    values, vectors = torch.linalg.eigh(-S)
    terms = [((d * values.clamp(-1, 1).arccos()).cos() * vectors**2).sum(1) for d in range(2, degree + 1)]
    at_zero = torch.tensor([(1, 0, -1, 0)[d % 4] for d in range(2, degree + 1)])
    close(chebyshev_diagonals(S, degree), torch.stack(terms, -1) - at_zero, 1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 5e-5)])
@pytest.mark.parametrize("seed", range(6))  # among them poses that flip the sign of the axis
def test_rigid_motion_and_scale_do_not_matter(dtype, tolerance, seed):
    means, scales, rotmats, mask = region()
    turn, size = rotation(seed), 10.0 ** (seed * 2 - 5)
    moved = (size * (means @ turn.T + torch.tensor([1.0, -2, 3])), size * scales, turn @ rotmats, mask)
    close(describe(moved, dtype=dtype), describe(region(), dtype=dtype), tolerance)


def test_order_does_not_matter():
    means, scales, rotmats, mask = region()
    p = torch.randperm(24, generator=torch.Generator().manual_seed(0))
    close(describe((means[:, p], scales[:, p], rotmats[:, p], mask)), describe(region())[:, p], 1e-12)


def test_signs_of_the_principal_axes_do_not_matter():
    means, scales, rotmats, mask = region()
    flipped = rotmats * torch.tensor([-1.0, 1, -1])
    assert torch.equal(describe((means, scales, flipped, mask)), describe(region()))


def test_mirror_image_is_the_same():
    means, scales, rotmats, mask = region()
    mirror = torch.diag(torch.tensor([1.0, 1, -1], dtype=torch.float64))
    close(describe((means @ mirror, scales, mirror @ rotmats, mask)), describe(region()), 1e-12)


def test_float32_agrees_with_float64():
    close(describe(region(), dtype=torch.float32).double(), describe(region()), 5e-6)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 20])
def test_padding_changes_nothing(n):
    whole = region(20)
    padded = [torch.cat([v[:, :n], torch.full_like(v, 7.0)], 1) for v in whole[:3]]
    mask = torch.arange(20 + n).expand(3, -1) < n
    found = describe((*padded, mask))
    assert (found[:, n:] == 0).all()
    if n:
        torch.testing.assert_close(found[:, :n], describe([v[:, :n] for v in whole]), rtol=1e-12, atol=1e-12)


def test_one_broken_gaussian_is_zeroed_and_leaves_the_rest_alone():
    means, scales, rotmats, mask = region()
    means[1, 4, 2] = torch.nan
    found = describe((means, scales, rotmats, mask))
    assert (found[1, 4] == 0).all()
    assert torch.equal(found[[0, 2]], describe(region())[[0, 2]])
    rest = [torch.cat([v[1:2, :4], v[1:2, 5:]], 1) for v in region()]
    torch.testing.assert_close(torch.cat([found[1:2, :4], found[1:2, 5:]], 1), describe(rest), rtol=1e-12, atol=1e-12)


CASES = {
    "coincident": lambda m, s: (m * 0, s),
    "collinear": lambda m, s: (m * torch.tensor([1.0, 0, 0]), s),
    "coplanar": lambda m, s: (m * torch.tensor([1.0, 1, 0]), s),
    "all scales zero": lambda m, s: (m, s * 0),
    "needles": lambda m, s: (m, s * torch.tensor([1e6, 1, 1])),
    "pancakes with a zero axis": lambda m, s: (m, s * torch.tensor([1e6, 1e6, 0])),
    "scales of 1e150": lambda m, s: (m, s * 1e150),
    "scales of 1e-150": lambda m, s: (m, s * 1e-150),
    "units of 1e150": lambda m, s: (m * 1e150, s * 1e150),
    "units of 1e-150": lambda m, s: (m * 1e-150, s * 1e-150),
    "offset of 1e6": lambda m, s: (m + 1e6, s),
    "one outlier at 1e8": lambda m, s: (torch.cat([m[:, :-1], m[:, -1:] * 0 + 1e8], 1), s),
    "far pairs": lambda m, s: (m + 1e5 * (torch.arange(m.shape[1]) // 2)[:, None], s),
}


@pytest.mark.parametrize("bandwidth", [1e-6, 1e-2, 0.7, 1e6])
@pytest.mark.parametrize("case", CASES)
def test_extreme_region_stays_finite_and_float32_agrees(case, bandwidth):
    means, scales, rotmats, mask = region()
    given = (*CASES[case](means, scales), rotmats, mask)
    exact = describe(given, bandwidth=bandwidth)
    assert torch.isfinite(exact).all()
    close(describe(given, bandwidth=bandwidth, dtype=torch.float32).double(), exact, 5e-6)
