"""A cut spectrum is the eigendecomposition's, and never depends on the basis of an eigenspace."""

import pytest
import torch
from shared_regions import CASES, region, turned

from chebsplat.settings import DescribeSection
from chebsplat.shape.albo import canonicalize, metric_factors, similarity
from chebsplat.shape.descriptor import describe, describe_members, n_degrees
from chebsplat.shape.spectra import cut_spectrum


def described(given, spectrum, **options):
    return describe(*given, spectrum=spectrum, dtype=torch.float64, backend="reference", **options)


def operator(given, bandwidth=0.7):
    found = canonicalize(*given)
    unturned = torch.eye(3, dtype=torch.float64).expand(len(given[0]), 3, 3)
    return similarity(found, metric_factors(found, 30.0), unturned, bandwidth)


def close(a, b, tolerance):
    assert (a - b).abs().max() <= tolerance * b.abs().max()


def test_hard_spectrum_sums_the_lowest_eigenpairs():
    S, mask = operator(region(20)), region(20)[3]
    values, vectors = torch.linalg.eigh(torch.eye(20, dtype=torch.float64) - S)
    angle = (2 * values[:, :6] / values[:, 5:6] - 1).clamp(-1, 1).arccos()
    terms = [20 * ((d * angle).cos()[:, None] * vectors[..., :6] ** 2).sum(-1) for d in range(5)]
    close(cut_spectrum(S, mask, 6, 4, hard=True).values, torch.stack(terms, -1), 1e-9)


def test_hard_spectrum_takes_in_whole_eigenspaces_and_counts_the_cuts_it_moved():
    pairs = CASES["far pairs"](*region(32))
    found = cut_spectrum(operator(pairs, 1e-3), pairs[3], 8, 4, hard=True)
    assert (found.n_cuts, found.n_clustered) == (3, 3)
    close(found.values[..., 0], torch.full((3, 32), 16.0, dtype=torch.float64), 1e-9)  # 16 zero modes of 32
    plain = cut_spectrum(operator(region()), region()[3], 8, 4, hard=True)
    assert (plain.n_cuts, plain.n_clustered) == (3, 0)


@pytest.mark.parametrize("spectrum", ["taper", "hard"])
@pytest.mark.parametrize("case", CASES)
def test_extreme_region_is_finite_and_repeatable(case, spectrum):
    for bandwidth in (1e-6, 0.7, 1e6):
        found = described(CASES[case](*region()), spectrum, bandwidth=bandwidth, n_eigs=8).values
        assert torch.isfinite(found).all()
        assert torch.equal(found, described(CASES[case](*region()), spectrum, bandwidth=bandwidth, n_eigs=8).values)


@pytest.mark.parametrize("case", ["coincident", "far pairs"])  # nearly all eigenvalues meet
@pytest.mark.parametrize("spectrum", ["taper", "hard"])
def test_order_does_not_matter_where_eigenvalues_meet(case, spectrum):
    means, scales, rotmats, mask = CASES[case](*region(32))
    p = torch.randperm(32, generator=torch.Generator().manual_seed(0))
    found = described((means[:, p], scales[:, p], rotmats[:, p], mask), spectrum, bandwidth=1e-3, n_eigs=8).values
    close(found, described((means, scales, rotmats, mask), spectrum, bandwidth=1e-3, n_eigs=8).values[:, p], 1e-9)


@pytest.mark.parametrize("spectrum", ["taper", "hard"])
def test_rigid_motion_does_not_matter(spectrum):
    means, scales, rotmats, mask = region()
    turn = turned(3)
    moved = (7.0 * (means @ turn.T) + 2.0, 7.0 * scales, turn @ rotmats, mask)
    # The divided gap at K is about 1e-2: it multiplies the round-off.
    close(described(moved, spectrum).values, described(region(), spectrum).values, 1e-10)


@pytest.mark.parametrize("spectrum", ["taper", "hard"])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 20])
def test_padding_changes_nothing(spectrum, n):
    whole = region(20)
    padded = [torch.cat([v[:, :n], torch.full_like(v, 7.0)], 1) for v in whole[:3]]
    found = described((*padded, torch.arange(20 + n).expand(3, -1) < n), spectrum).values
    assert not found[:, n:].any()
    if n:
        torch.testing.assert_close(found[:, :n], described([v[:, :n] for v in whole], spectrum).values)
    if n == 1:
        assert not found.any()


@pytest.mark.parametrize("spectrum", ["full", "taper", "hard"])
def test_members_are_described_with_the_spectrum_that_was_chosen(spectrum):
    g = torch.Generator().manual_seed(0)
    means, quats, scales = (torch.randn(40, k, generator=g) for k in (3, 4, 3))
    members = torch.randint(0, 40, (5, 12), generator=g)
    settings = DescribeSection(n_angles=4, max_degree=8, spectrum=spectrum, n_eigs=4)
    found = describe_members(*(v.numpy() for v in (means, quats, scales.exp(), members)), settings)
    assert found.values.shape == (5, 12, 4, n_degrees(spectrum, 8))
    assert found.n_cuts == (20 if spectrum == "hard" else 0)


@pytest.mark.parametrize("case", ["coincident", "square lattice", "cubic lattice", "collinear", "far pairs"])
def test_gradient_to_the_centres_is_finite_where_centres_or_eigenvalues_meet(case):
    means, scales, rotmats, mask = CASES[case](*region())
    means = means.clone().requires_grad_(True)
    described((means, scales, rotmats, mask), "full").values.square().sum().backward()
    assert torch.isfinite(means.grad).all()
