"""The compiled descriptor agrees with the float64 oracle everywhere, keeps its invariances, and never wavers."""

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shared_regions import CASES, region, turned

from chebsplat.settings import DescribeSection
from chebsplat.shape.descriptor import describe, describe_members
from chebsplat.splats.rotations import rotation_matrices

WORST, MEDIAN = 5e-6, 5e-7  # issue bars, relative to the region's maximum


def compiled(given, **options):
    return describe(*given, **options, backend="numba").values


def exact(given, **options):
    return describe(*given, **options, dtype=torch.float64, backend="reference").values


def errors(found, expected):
    """Largest difference of each region, relative to its largest value."""
    largest = expected.abs().amax((1, 2, 3))
    worst = (found.double() - expected.double()).abs().amax((1, 2, 3))
    return worst / torch.where(largest > 0, largest, 1.0)


@pytest.mark.parametrize(("n", "n_angles", "max_degree"), [(64, 4, 8), (33, 1, 2), (17, 3, 7), (100, 5, 13), (5, 2, 3)])
def test_compiled_descriptor_agrees_with_the_oracle_to_float32(n, n_angles, max_degree):
    sizes = {"n_angles": n_angles, "max_degree": max_degree}
    found = errors(compiled(region(n, 1, 16), **sizes), exact(region(n, 1, 16), **sizes))
    assert found.median() <= MEDIAN
    assert found.max() <= WORST


@pytest.mark.parametrize("bandwidth", [1e-6, 1e-2, 0.1, 0.7, 1e6])
@pytest.mark.parametrize("case", CASES)
def test_extreme_region_is_finite_repeatable_and_right(case, bandwidth):
    extreme = CASES[case](*region(64))
    found = compiled(extreme, bandwidth=bandwidth)
    assert torch.isfinite(found).all()
    assert torch.equal(found, compiled(extreme, bandwidth=bandwidth))
    # At 1e-6 logarithms of weights reach 1e12 and float64 rounds them by 1e-4: where edges are equally long, that is
    # the error of the oracle, too.
    limit = 20 * WORST if "lattice" in case and bandwidth == 1e-6 else WORST
    assert errors(found, exact(extreme, bandwidth=bandwidth)).max() <= limit


@pytest.mark.parametrize("anisotropy", [0.0, 1e-12, 1e6, 1e12])
def test_extreme_anisotropy_is_right(anisotropy):
    assert errors(compiled(region(), anisotropy=anisotropy), exact(region(), anisotropy=anisotropy)).max() <= WORST


@given(seed=st.integers(0, 10**6), power=st.floats(-6, 6), n=st.integers(2, 64), mirrored=st.booleans())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_motion_size_and_mirror_do_not_matter(seed, power, n, mirrored):
    means, scales, rotmats, mask = region(n, seed, 4)
    turn = turned(seed + 1) @ torch.diag(torch.tensor([1.0, 1.0, -1.0 if mirrored else 1.0], dtype=torch.float64))
    size = 10.0**power
    shift = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    moved = (size * (means @ turn.T + shift), size * scales, turn @ rotmats, mask)
    assert errors(compiled(moved), compiled((means, scales, rotmats, mask))).max() <= 5e-5


def test_turning_the_axis_over_does_not_matter():
    means, scales, rotmats, mask = region(48, 3, 8)
    for k in range(3):  # half turns about each coordinate axis: the axis' sign flips in some of them
        turn = -torch.eye(3, dtype=torch.float64)
        turn[k, k] = 1.0
        moved = (means @ turn.T, scales, turn @ rotmats, mask)
        assert errors(compiled(moved), compiled((means, scales, rotmats, mask))).max() <= 5e-6


@given(seed=st.integers(0, 10**6), n=st.integers(2, 64))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_order_does_not_matter(seed, n):
    means, scales, rotmats, mask = region(n, seed, 2)
    p = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    found = compiled((means[:, p], scales[:, p], rotmats[:, p], mask))
    assert errors(found, compiled((means, scales, rotmats, mask))[:, p]).max() <= 5e-6


def test_signs_of_the_principal_axes_change_no_bit():
    means, scales, rotmats, mask = region()
    flipped = rotmats * torch.tensor([-1.0, 1, -1])
    assert torch.equal(compiled((means, scales, flipped, mask)), compiled(region()))


@pytest.mark.parametrize("n", [0, 1, 2, 3, 20])
def test_padding_changes_no_bit(n):
    whole = region(20)
    padded = [
        torch.cat([torch.full_like(v[:, :5], torch.nan), v[:, :n], torch.full_like(v, 7.0)], 1) for v in whole[:3]
    ]
    place = torch.arange(25 + n)
    found = compiled((*padded, ((place >= 5) & (place < n + 5)).expand(3, -1)))
    assert torch.equal(found[:, 5 : n + 5], compiled([v[:, :n] for v in whole]))
    assert not found[:, :5].any() and not found[:, n + 5 :].any()


def test_one_broken_gaussian_is_zeroed_and_leaves_the_rest_alone():
    means, scales, rotmats, mask = region()
    means[1, 4, 2] = torch.nan
    found = compiled((means, scales, rotmats, mask))
    assert not found[1, 4].any()
    assert torch.equal(found[[0, 2]], compiled(region())[[0, 2]])
    rest = compiled([torch.cat([v[1:2, :4], v[1:2, 5:]], 1) for v in region()])
    assert torch.equal(torch.cat([found[1:2, :4], found[1:2, 5:]], 1), rest)


def test_any_number_of_threads_gives_the_same_bits():
    expected, before = None, numba.get_num_threads()
    try:
        for threads in (1, 2, 4):
            numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
            found = compiled(region(40, 2, 100))
            assert expected is None or torch.equal(found, expected)
            expected = found
    finally:
        numba.set_num_threads(before)


def test_a_region_of_one_has_no_edge_and_is_zero():
    assert not compiled(region(1)).any()
    assert not exact(region(1)).any()


@pytest.mark.parametrize("n", [2, 7, 64])
def test_coincident_gaussians_have_the_values_of_the_complete_graph(n):
    means, _, rotmats, mask = region(n)
    found = compiled((means * 0 + 1e3, means * 0, rotmats, mask))[:, :, 0]
    for d in range(2, 9):
        at = np.polynomial.chebyshev.Chebyshev.basis(d)
        value = at(-1) + (n - 1) * at(1 / (n - 1)) - n * at(0)  # S has eigenvalues 1 and -1/(n-1)
        assert abs(found[..., d - 2] - value).max() <= 5e-6 * 2 * n


@pytest.mark.parametrize("bandwidth", [1e-3, 1e-12])  # the second underflows every weight, even in float64
def test_separate_pairs_have_the_values_of_single_edges(bandwidth):
    extreme = CASES["far pairs"](*region(32))
    found = compiled(extreme, bandwidth=bandwidth)[:, :, 0]
    for d in range(2, 9):
        at = np.polynomial.chebyshev.Chebyshev.basis(d)
        assert abs(found[..., d - 2] - 32 * (0.5 * at(1) + 0.5 * at(-1) - at(0))).max() <= 5e-6 * 64


def test_gathered_members_are_described_like_their_regions():
    g = torch.Generator().manual_seed(0)
    means, quats, scales = (torch.randn(50, k, generator=g) for k in (3, 4, 3))
    members = torch.randint(-1, 50, (9, 12), generator=g)
    index = members.clamp_min(0)
    options = {"n_angles": 4, "max_degree": 8, "anisotropy": 30.0, "bandwidth": 0.7}
    arrays = (v.numpy() for v in (means, quats, scales.exp(), members))
    found = torch.from_numpy(describe_members(*arrays, DescribeSection(**options), chunk=4).values)
    rotmats = rotation_matrices(quats.double())[index]
    wanted = compiled((means[index], scales.exp()[index], rotmats, members >= 0), **options)
    assert (found - wanted).abs().max() <= 1e-6 * wanted.abs().max()  # the rounding of the rotations


@pytest.mark.parametrize("bad", [{"bandwidth": 0.0}, {"n_angles": 0}, {"max_degree": 1}, {"anisotropy": -1.0}])
def test_senseless_parameters_are_refused(bad):
    with pytest.raises(ValueError, match="needed"):
        describe(*region(), **bad, backend="numba")


@pytest.mark.parametrize(
    "beyond", [{"spectrum": "hard"}, {"dtype": torch.float64}, {"gradient": True}, {"backend": "cuda"}]
)
def test_a_backend_refuses_what_it_does_not_compute(beyond):
    means, *rest = region(4)
    means = means.clone().requires_grad_(beyond.pop("gradient", False))
    with pytest.raises(ValueError, match="backend"):
        describe(means, *rest, **({"backend": "numba"} | beyond))
