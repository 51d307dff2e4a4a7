"""Exposures of rendered colours."""

import numpy as np
import pytest
import torch

from chebsplat.photos.exposures import relit
from chebsplat.splats.exposure import cut_off, exposed

STOPS = torch.tensor([0.7, 0.0, -1.2])


def test_rendered_colors_take_an_exposure_as_photos_do():
    grey = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, 2)
    ours = exposed(torch.from_numpy(grey).double() / 255, STOPS.double()).clamp(0, 1) * 255
    assert np.abs(ours.numpy() - relit(grey, STOPS.numpy())).max() <= 0.9
    assert ours[0, 0].tolist() == pytest.approx([0, 0, 0])


def test_light_beyond_white_is_there_again_in_a_darker_photo():
    bright = exposed(torch.full((1, 3), 0.9), torch.full((3,), 2.0))
    assert (bright > 1.5).all()
    assert torch.allclose(exposed(bright, torch.full((3,), -2.0)), torch.full((1, 3), 0.9))


def test_gradients_of_exposed_colors_are_those_of_differences():
    colors = torch.tensor([1e-4, 0.02, 0.04, 0.2, 1.3])[:, None].repeat(1, 3).double()
    assert torch.autograd.gradcheck(lambda c: exposed(c, STOPS.double()), colors.requires_grad_())


def test_white_of_a_photo_is_as_much_light_at_least():
    """Up to 250 of 255 a photo is no white. What is cut off has no gradient."""
    photo, colors = (
        torch.tensor(values)[:, None].repeat(1, 3)
        for values in ([1.0, 1.0, 250 / 255, 251 / 255, 0.2], [1.3, 0.8, 1.3, 1.3, 0.3])
    )
    found = cut_off(colors.requires_grad_(), photo)
    assert found[:, 0].tolist() == pytest.approx([1.0, 0.8, 1.3, 251 / 255, 0.3])
    found.sum().backward()
    assert colors.grad[:, 0].tolist() == [0, 1, 1, 0, 1]
