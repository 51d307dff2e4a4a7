"""SH masks are nested, histograms keep their mass, and gradients stay finite."""

import pytest
import torch

from chebsplat import sh_prune


def test_masks_are_nested_and_degree_is_the_highest_band_kept():
    logits = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * 6
    mask = sh_prune.band_mask(logits)
    assert (mask.diff(dim=1) <= 1e-6).all()
    assert torch.equal(sh_prune.degrees(mask).float(), (mask > 0.5).sum(1).float())
    assert len(sh_prune.degrees(mask).unique()) == 4


def test_masked_bands_vanish_and_band_zero_is_untouched():
    shN = torch.ones(1, 15, 3)
    out = sh_prune.masked_sh(shN, torch.tensor([[1.0, 0.0, 0.0]]))
    assert out[0, :3].eq(1).all()
    assert out[0, 3:].eq(0).all()
    assert sh_prune.masked_sh(shN[:, :3], torch.tensor([[1.0, 0.0, 0.0]])).shape == (1, 3, 3)


@pytest.mark.parametrize("case", ["spread", "constant", "two far apart"])
def test_histogram_has_mass_one_and_finite_gradients(case):
    values = {
        "spread": torch.linspace(-1, 1, 30),
        "constant": torch.full((30,), 0.3),
        "two far apart": torch.tensor([-1e6, 1e6]),
    }[case].requires_grad_(True)
    valid = torch.ones(len(values), dtype=torch.bool)
    found = sh_prune.soft_histogram(values, valid, 8, values.detach().min(), values.detach().max())
    assert abs(found.sum().item() - 1) < 1e-5
    (found**2).sum().backward()
    assert torch.isfinite(values.grad).all()


def test_histogram_of_nothing_is_zero():
    nothing = torch.zeros(3, dtype=torch.bool)
    found = sh_prune.soft_histogram(torch.zeros(3), nothing, 4, torch.tensor(0.0), torch.tensor(1.0))
    assert (found == 0).all()


def test_guidance_spares_the_bands_that_colour_a_region():
    shN = torch.zeros(40, 15, 3)
    shN[:, :3] = torch.randn(40, 3, 1, generator=torch.Generator().manual_seed(0))
    weight = sh_prune.region_guidance(shN, torch.arange(40).reshape(2, 20), 40)
    assert (weight[:, 0] < 0.6).all()
    assert (weight[:, 1:] > 0.95).all()


def test_guidance_is_one_outside_regions_and_without_regions():
    shN = torch.ones(5, 15, 3)
    weight = sh_prune.region_guidance(shN, torch.tensor([[0, 1, -1]]), 5)
    assert (weight[2:] == 1).all()
    assert (sh_prune.region_guidance(shN, torch.zeros(0, 3, dtype=torch.int64), 5) == 1).all()


def test_loss_weights_bands_by_their_number_of_coefficients():
    mask = torch.eye(3, requires_grad=True)
    assert sh_prune.sh_loss(mask).item() == pytest.approx(5.0)
    sh_prune.sh_loss(mask).backward()
    assert torch.allclose(mask.grad * 3, torch.tensor([3.0, 5.0, 7.0]).expand(3, 3))
    assert sh_prune.sh_loss(torch.zeros(0, 3)).item() == 0
