"""The knowledge basis stays orthonormal and bounded, whatever it is fed."""

import pytest
import torch

from chebsplat.cks import basis_loss, residual_of, update


def weights(q=32, p=32, rank=None, seed=0):
    g = torch.Generator().manual_seed(seed)
    if rank is None:
        return torch.randn(q, p, generator=g)
    return torch.randn(q, rank, generator=g) @ torch.randn(rank, p, generator=g)


def orthonormality(basis):
    error = basis.double().T @ basis.double() - torch.eye(basis.shape[1], dtype=torch.float64)
    return error.abs().max().item() if error.numel() else 0.0


EXTREMES = {
    "huge": weights() * 1e25,
    "tiny": weights() * 1e-25,
    "rank one": weights(rank=1),
    "parallel": weights(rank=1) + 1e-7 * weights(seed=1),
    "one entry": torch.zeros(32, 32).index_put((torch.tensor(3), torch.tensor(4)), torch.tensor(1.0)),
}


@pytest.mark.parametrize("case", EXTREMES)
def test_extreme_weights_give_a_finite_orthonormal_basis(case):
    basis, report = update(None, EXTREMES[case])
    assert orthonormality(basis) < 3e-7
    again, second = update(basis, EXTREMES[case])
    assert orthonormality(again) < 3e-7
    assert 0 <= second["rho"] <= 1
    assert report["rank_after"] >= 1


def test_zero_weights_change_nothing():
    basis, report = update(None, torch.zeros(8, 8))
    assert basis.shape == (8, 0)
    assert report["rho"] == 0
    full, _ = update(None, weights(8, 8))
    again, _ = update(full, torch.zeros(8, 8))
    assert torch.allclose(again, full, atol=1e-6)


def test_what_is_already_inside_adds_no_column():
    basis, _ = update(None, weights(rank=4), energy=0.999999)
    again, report = update(basis, weights(rank=4))
    assert again.shape == basis.shape
    assert report["rho"] < 1e-5


def test_total_rule_adds_fewer_columns_than_the_residual_rule():
    basis, _ = update(None, weights(rank=6), energy=0.9999)
    new = weights(rank=6) + 0.3 * weights(seed=5)
    total, _ = update(basis, new, rule="total")
    residual, _ = update(basis, new, rule="residual")
    assert basis.shape[1] <= total.shape[1] <= residual.shape[1]


def test_two_hundred_updates_never_reach_the_full_space():
    basis = None
    for seed in range(200):
        basis, _ = update(basis, weights(seed=seed))
    assert basis.shape[1] <= 16
    assert orthonormality(basis) < 3e-7


def test_a_residual_of_a_millionth_is_no_news():
    basis, _ = update(None, weights(rank=4), energy=0.999999)
    _, report = update(basis, weights(rank=4) + 1e-6 * weights(seed=9))
    assert report["rank_after"] == basis.shape[1]


def test_residual_is_orthogonal_to_the_basis():
    basis, _ = update(None, weights(rank=5))
    assert (basis.double().T @ residual_of(weights(seed=3), basis)).abs().max() < 1e-6


def test_regulariser_is_zero_inside_and_scale_free_outside():
    basis, _ = update(None, weights(rank=4), energy=0.999999)
    inside, outside = weights(rank=4), weights(seed=3)
    assert basis_loss({"a": inside}, {"a": basis}).item() < 1e-8
    a, b = (basis_loss({"a": outside * s}, {"a": basis}).item() for s in (1.0, 1e3))
    assert a == pytest.approx(b, rel=1e-4)
    assert 0 < a <= 1


def test_non_finite_weights_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        update(None, torch.full((4, 4), torch.nan))
