"""SH masks are nested, histograms keep their mass, and gradients stay finite."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chebsplat.splats.sh import basis, eval_sh
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


# histograms


def test_histogram_of_well_placed_values_is_the_plain_one():
    values = torch.tensor([0.05, 0.15, 0.15, 0.35, 0.95])
    found = sh_prune.soft_histogram(
        values, torch.ones(5, dtype=torch.bool), 10, torch.tensor(0.0), torch.tensor(1.0)
    )
    plain = torch.histc(values, 10, 0, 1) / 5
    assert (found >= 0).all()
    assert torch.allclose(found, plain, atol=1e-4)  # half a bin from an edge: sigmoid(-10) = 5e-5


# guidance


def test_band_colours_add_up_to_the_view_dependent_colour():
    shN, directions = (
        normal(20, 15, 3),
        torch.nn.functional.normalize(normal(20, 3, seed=1), dim=-1),
    )
    whole = torch.einsum("nk,nkc->nc", basis(directions, 3)[:, 1:], shN)
    assert torch.allclose(sh_prune.band_colors(shN, directions).sum(1), whole, atol=1e-5)
    shared = sh_prune.band_colors(shN, directions[:4, None])
    assert shared.shape == (4, 20, 3, 3)
    assert torch.allclose(
        shared[2], sh_prune.band_colors(shN, directions[2].expand(20, 3)), atol=1e-6
    )
    assert (sh_prune.band_colors(shN[:, :3], directions)[:, 1:] == 0).all()


def test_no_function_of_a_band_is_invisible_to_the_guidance():
    directions = sh_prune.guidance_directions()
    assert torch.allclose(directions.norm(dim=1), torch.ones(10))
    values = basis(directions, 3)[:, 1:]
    assert all(torch.linalg.svdvals(values[:, a:b]).min() > 0.4 for a, b in sh_prune.BANDS)


@pytest.mark.parametrize("column", range(15))
def test_guidance_spares_a_band_whichever_coefficient_colours_the_region(column):
    shN = torch.zeros(40, 15, 3)
    shN[:, column] = normal(40, 3)
    band = next(i for i, (a, b) in enumerate(sh_prune.BANDS) if a <= column < b)
    weight = sh_prune.region_guidance(shN, torch.arange(40).reshape(2, 20), 40)
    assert (weight[:, : band + 1] < 0.8).all()
    assert (weight[:, band + 1 :] > 0.95).all()


def test_opposite_changes_of_two_channels_do_not_cancel():
    shN = torch.zeros(20, 15, 3)
    shN[:, :3, 0] = normal(20, 3)
    shN[:, :3, 1] = -shN[:, :3, 0]
    assert (sh_prune.region_guidance(shN, torch.arange(20)[None], 20)[:, 0] < 0.7).all()


def test_colours_that_no_screen_shows_are_not_spared():
    invisible = normal(20, 15, 3) * 1e-4
    assert (sh_prune.region_guidance(invisible, torch.arange(20)[None], 20) > 0.99).all()
    assert (sh_prune.region_guidance(invisible * 1e4, torch.arange(20)[None], 20)[:, 0] < 0.5).all()


@settings(deadline=None, derandomize=True, max_examples=25)
@given(
    log_size=st.integers(-30, 30), held=st.sampled_from([0, 3, 8, 15]), seed=st.integers(0, 10**6)
)
def test_guidance_lies_within_bounds_and_never_presses_a_band_below_one_that_is_needed(
    log_size, held, seed
):
    members = torch.randint(-1, 30, (4, 8), generator=torch.Generator().manual_seed(seed))
    weight = sh_prune.region_guidance(normal(30, held, 3, seed=seed) * 10.0**log_size, members, 30)
    assert ((weight >= 0.05 - 1e-6) & (weight <= 1)).all()
    assert (weight.diff(dim=1) >= -1e-6).all()


def test_guidance_is_one_outside_regions_and_without_regions():
    shN = torch.ones(5, 15, 3)
    weight = sh_prune.region_guidance(shN, torch.tensor([[0, 1, -1], [-1, -1, -1]]), 5)
    assert (weight[:2, 0] < 1).all()
    assert (weight[2:] == 1).all()
    assert (sh_prune.region_guidance(shN, torch.zeros(0, 3, dtype=torch.int64), 5) == 1).all()
    assert (sh_prune.region_guidance(shN, torch.full((2, 3), -1), 5) == 1).all()
    assert sh_prune.region_guidance(shN[:0], torch.zeros(0, 3, dtype=torch.int64), 0).shape == (
        0,
        3,
    )


def test_loss_weights_bands_by_their_number_of_coefficients_and_by_the_guidance():
    mask = torch.eye(3, requires_grad=True)
    assert sh_prune.sh_loss(mask).item() == pytest.approx(5.0)
    guided = sh_prune.sh_loss(mask, torch.tensor([0.5, 1.0, 0.1]))
    assert guided.item() == pytest.approx((1.5 + 5.0 + 0.7) / 3)
    sh_prune.sh_loss(mask).backward()
    assert torch.allclose(mask.grad * 3, torch.tensor([3.0, 5.0, 7.0]).expand(3, 3))
    assert sh_prune.sh_loss(torch.zeros(0, 3)).item() == 0
