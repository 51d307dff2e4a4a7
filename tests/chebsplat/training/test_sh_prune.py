"""SH masks are nested, and gradients stay finite."""

from itertools import pairwise

import pytest
import torch

from chebsplat.splats.sh import eval_sh
from chebsplat.training import sh_prune


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


# masks


def test_masks_are_binary_nested_and_degree_is_the_highest_band_kept():
    logits = torch.cat([normal(500, 3) * 6, torch.tensor([[-1e30, 1e30, -1e30]])])
    logits.requires_grad_(True)
    mask = sh_prune.band_mask(logits)
    sh_prune.sh_loss(mask).backward()
    assert torch.isfinite(logits.grad).all()
    assert set(mask.unique().tolist()) == {0.0, 1.0}
    assert (mask.diff(dim=1) <= 0).all()
    assert torch.equal(sh_prune.degrees(mask).float(), mask.sum(1))
    assert sh_prune.degrees(mask).dtype == torch.uint8
    assert len(sh_prune.degrees(mask).unique()) == 4


def test_a_higher_band_teaches_the_lower_bands_that_carry_it():
    logits = torch.zeros(1, 3, requires_grad=True)
    sh_prune.band_mask(logits)[0, 2].backward()
    assert torch.allclose(logits.grad, torch.full((1, 3), 0.5**4))


def test_masked_bands_vanish_and_band_zero_is_untouched():
    shN = torch.ones(1, 15, 3)
    out = sh_prune.masked_sh(shN, torch.tensor([[1.0, 0.0, 0.0]]))
    assert out[0, :3].eq(1).all()
    assert out[0, 3:].eq(0).all()
    for held in (0, 3, 8):
        assert sh_prune.masked_sh(shN[:, :held], torch.tensor([[1.0, 0.0, 0.0]])).shape == (
            1,
            held,
            3,
        )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ragged_coefficients_render_like_masked_ones(degree):
    n = 60
    sh0, shN, kept = (
        normal(n, 1, 3),
        normal(n, 15, 3, seed=1),
        torch.arange(n).remainder(degree + 1).to(torch.uint8),
    )
    rows = sh_prune.ragged_rows(kept)
    assert all(torch.equal(longer[: len(shorter)], shorter) for longer, shorter in pairwise(rows))
    assert all(
        (kept[rows[band]] >= band).all() and len(rows[band]) == (kept >= band).sum()
        for band in range(4)
    )
    assert all((rows[0][kept[rows[0]] == band].diff() > 0).all() for band in range(4))  # stable
    bands = [
        shN[part, first:last] for part, (first, last) in zip(rows[1:], sh_prune.BANDS, strict=True)
    ]
    directions = normal(n, 3, seed=2)[rows[0]]
    masked = sh_prune.masked_sh(shN, (torch.arange(1, 4) <= kept[:, None]).float())[rows[0]]
    found = eval_sh(sh0[rows[0]], sh_prune.dense(bands, n), directions, 3)
    assert torch.equal(found, eval_sh(sh0[rows[0]], masked, directions, 3))


def test_ragged_of_nothing_and_of_a_degree_that_does_not_exist():
    assert [len(rows) for rows in sh_prune.ragged_rows(torch.zeros(0, dtype=torch.uint8))] == [
        0,
        0,
        0,
        0,
    ]
    assert sh_prune.dense([], 2).shape == (2, 15, 3)
    with pytest.raises(ValueError, match="degree 4"):
        sh_prune.ragged_rows(torch.tensor([0, 4], dtype=torch.uint8))


def test_loss_weights_bands_by_their_number_of_coefficients():
    mask = torch.eye(3, requires_grad=True)
    assert sh_prune.sh_loss(mask).item() == pytest.approx(5.0)
    sh_prune.sh_loss(mask).backward()
    assert torch.allclose(mask.grad * 3, torch.tensor([3.0, 5.0, 7.0]).expand(3, 3))
    assert sh_prune.sh_loss(torch.zeros(0, 3)).item() == 0
