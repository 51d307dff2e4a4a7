"""Every descriptor ignores pose, size, order and signs; the compiled one agrees with float64 and
never wavers.

Extreme regions are cases of the stability suite, against 60 digits.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shared_regions import REGIONS, descriptor_of, extreme, region, turned
from thread_counts import assert_same_bits

from chebsplat.settings import DescribeSection
from chebsplat.shape.descriptor import describe_members
from chebsplat.shape.descriptor_reference import chebyshev_diagonals
from chebsplat.splats.rotations import rotation_matrices

WORST, MEDIAN = 5e-6, 5e-7  # issue bars, relative to the region's maximum
FLOAT64 = {"dtype": torch.float64, "backend": "reference"}
ROUTES = {  # options, and what a motion may change
    "compiled": ({"backend": "numba"}, 5e-5),
    "full": (FLOAT64, 1e-12),
}


def described(route, given, **options):
    return descriptor_of(*given, **ROUTES[route][0], **options).values


def errors(found, expected):
    """Largest difference of each region, relative to its largest value."""
    largest = expected.abs().amax((1, 2, 3))
    worst = (found.double() - expected.double()).abs().amax((1, 2, 3))
    return worst / torch.where(largest > 0, largest, 1.0)


every_route = pytest.mark.parametrize("route", ROUTES)


@every_route
@given(
    seed=st.integers(0, 10**6),
    power=st.floats(-6, 6),
    n=st.integers(20, 64),
    mirrored=st.booleans(),
)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_motion_size_and_mirror_do_not_matter(route, seed, power, n, mirrored):
    means, scales, rotmats, mask = region(n, seed, 2)
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0 if mirrored else 1.0], dtype=torch.float64))
    turn, size = turned(seed + 1) @ mirror, 10.0**power
    shift = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    moved = (size * (means @ turn.T + shift), size * scales, turn @ rotmats, mask)
    still = described(route, (means, scales, rotmats, mask))
    assert errors(described(route, moved), still).max() <= ROUTES[route][1]


@every_route
# in two nearly all eigenvalues meet
@pytest.mark.parametrize("name", [None, "coincident", "far pairs"])
def test_order_does_not_matter(route, name):
    means, scales, rotmats, mask = extreme(name) if name else region(32)
    p = torch.randperm(means.shape[1], generator=torch.Generator().manual_seed(0))
    found = described(route, (means[:, p], scales[:, p], rotmats[:, p], mask))
    expected = described(route, (means, scales, rotmats, mask))[:, p]
    assert errors(found, expected).max() <= (WORST if route == "compiled" else 1e-9)


@every_route
def test_signs_of_the_principal_axes_change_no_bit(route):
    means, scales, rotmats, mask = region()
    flipped = rotmats * torch.tensor([-1.0, 1, -1])
    assert torch.equal(described(route, (means, scales, flipped, mask)), described(route, region()))


@every_route
@pytest.mark.parametrize("n", [0, 1, 2, 3, 20])
@pytest.mark.parametrize("before", ["padding", "broken"])
def test_padding_and_broken_gaussians_are_zero_and_leave_the_rest_alone(route, n, before):
    whole = region(20)
    padded = [torch.cat([torch.full_like(v[:, :5], torch.nan), v[:, :n], torch.full_like(v, 7.0)],
                        1)
              for v in whole[:3]]  # fmt: skip
    place = torch.arange(25 + n)
    present = (place < n + 5) & ((place >= 5) | (before == "broken"))
    found = described(route, (*padded, present.expand(3, -1)))
    assert not found[:, :5].any() and not found[:, n + 5 :].any()
    bare = described(route, [v[:, :n] for v in whole]) if n else found[:, :0]
    assert n != 1 or not bare.any()  # no edge
    tolerance = 0 if route == "compiled" else 1e-9
    torch.testing.assert_close(found[:, 5 : n + 5], bare, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("degree", range(2, 13))
def test_recurrence_equals_the_eigendecomposition(degree):
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(20, 20, generator=g, dtype=torch.float64)
    weights = (weights + weights.T).fill_diagonal_(0)
    root = weights.sum(1).rsqrt()
    S = root[:, None] * weights * root
    values, vectors = torch.linalg.eigh(-S)
    terms = [
        ((d * values.clamp(-1, 1).arccos()).cos() * vectors**2).sum(1) for d in range(2, degree + 1)
    ]
    expected = torch.stack(terms, -1) - torch.tensor(
        [(1, 0, -1, 0)[d % 4] for d in range(2, degree + 1)]
    )
    assert (chebyshev_diagonals(S, degree) - expected).abs().max() <= 1e-12 * expected.abs().max()


@pytest.mark.parametrize(
    ("n", "n_angles", "max_degree"), [(64, 4, 8), (33, 1, 2), (17, 3, 7), (100, 5, 13), (5, 2, 3)]
)
def test_compiled_descriptor_agrees_with_float64(n, n_angles, max_degree):
    sizes = {"n_angles": n_angles, "max_degree": max_degree}
    found = errors(*(described(route, region(n, 1, 16), **sizes) for route in ("compiled", "full")))
    assert found.median() <= MEDIAN
    assert found.max() <= WORST


@pytest.mark.parametrize("bandwidth", [1e-6, 1e-2, 0.1, 1e6])
@pytest.mark.parametrize("name", REGIONS)
def test_extreme_region_at_extreme_bandwidth_agrees_with_float64(name, bandwidth):
    found, exact = (
        described(route, extreme(name), bandwidth=bandwidth) for route in ("compiled", "full")
    )
    assert torch.isfinite(found).all()
    # At 1e-6 logarithms of weights reach 1e12 and float64 rounds them by 1e-4: where edges are
    # equally long, that is the error of the oracle, too. At 0.1 those of edges that count reach
    # 100, and float32 rounds them by 1e-5.
    equal = any(word in name for word in ("lattice", "ring", "round"))
    limit = {1e-6: 20 * WORST if equal else WORST, 0.1: 2 * WORST}.get(bandwidth, WORST)
    assert errors(found, exact).max() <= limit


def test_any_number_of_threads_gives_the_same_bits():
    assert_same_bits(lambda: described("compiled", region(40, 2, 100)))


def test_gathered_members_are_described_like_their_regions():
    g = torch.Generator().manual_seed(0)
    means, quats, scales = (torch.randn(50, k, generator=g) for k in (3, 4, 3))
    members = torch.randint(-1, 50, (9, 12), generator=g)
    index = members.clamp_min(0)
    options = {"n_angles": 4, "max_degree": 8, "anisotropy": 30.0, "bandwidth": 0.7}
    arrays = (v.numpy() for v in (means, quats, scales.exp(), members))
    found = describe_members(*arrays, DescribeSection(**options), chunk=4)
    regions = means[index], scales.exp()[index], rotation_matrices(quats)[index], members >= 0
    wanted = descriptor_of(*regions, **options, dtype=torch.float64)
    error = (torch.from_numpy(found.values) - wanted.values).abs().max()
    assert error <= 1e-6 * wanted.values.abs().max()  # float32, the rounding of the rotations


@pytest.mark.parametrize(
    "bad", [{"bandwidth": 0.0}, {"n_angles": 0}, {"max_degree": 1}, {"anisotropy": -1.0}]
)
def test_senseless_parameters_are_refused(bad):
    with pytest.raises(ValueError, match="needed"):
        described("compiled", region(), **bad)


@pytest.mark.parametrize(
    "beyond", [{"dtype": torch.float64}, {"gradient": True}, {"backend": "cuda"}]
)
def test_a_backend_refuses_what_it_does_not_compute(beyond):
    means, *rest = region(4)
    means = means.clone().requires_grad_(beyond.pop("gradient", False))
    with pytest.raises(ValueError, match="backend"):
        descriptor_of(means, *rest, **({"backend": "numba"} | beyond))
