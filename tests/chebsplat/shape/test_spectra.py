"""A cut spectrum is the eigendecomposition's, and never depends on the basis of an eigenspace."""

import pytest
import torch
from shared_regions import REGIONS, extreme, region

from chebsplat.shape.albo import canonicalize, cut_spectrum, metric_factors, similarity
from chebsplat.shape.described import Descriptor
from chebsplat.shape.descriptor import describe


def described(given, spectrum, **options):
    return describe(*given, Descriptor(spectrum=spectrum, **options), dtype=torch.float64, backend="reference")


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
    pairs = extreme("far pairs")
    found = cut_spectrum(operator(pairs, 1e-3), pairs[3], 8, 4, hard=True)
    assert (found.n_cuts, found.n_clustered) == (1, 1)
    close(found.values[..., 0], torch.full((1, 32), 16.0, dtype=torch.float64), 1e-9)  # 16 zero modes of 32
    plain = cut_spectrum(operator(region()), region()[3], 8, 4, hard=True)
    assert (plain.n_cuts, plain.n_clustered) == (3, 0)


@pytest.mark.parametrize("spectrum", ["taper", "hard"])
@pytest.mark.parametrize("name", REGIONS)
def test_extreme_region_is_finite_and_repeatable(name, spectrum):
    for bandwidth in (1e-6, 0.7, 1e6):
        found, again = (described(extreme(name), spectrum, bandwidth=bandwidth, n_eigs=8).values for _ in range(2))
        assert torch.isfinite(found).all()
        assert torch.equal(found, again)
