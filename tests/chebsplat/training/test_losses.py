"""Losses equal their plain-torch definitions, in value and gradient, and masked pixels do not
exist.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from chebsplat.training.losses import (
    feature_distance,
    feature_distance_reference,
    photometric,
    photometric_reference,
    ssim,
    ssim_map,
)


def images(height=40, width=52, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, generator=g), torch.rand(height, width, 3, generator=g)


@pytest.mark.parametrize("weight_ssim", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("counted", ["all alike", "some", "more or less"])
@pytest.mark.parametrize("size", [(40, 52), (7, 5)], ids=["image", "smaller than the window"])
def test_photometric_equals_the_oracle(size, counted, weight_ssim):
    render, target = images(*size)
    amounts = (torch.rand(size, generator=torch.Generator().manual_seed(1)) - 0.3).clamp_min(0)
    mask = {"all alike": None, "some": amounts > 0, "more or less": amounts}[counted]
    exact = render.double().requires_grad_(True)
    value = photometric_reference(exact, target.double(), mask, weight_ssim)
    value.backward()
    render.requires_grad_(True)
    found = photometric(render, target, mask, weight_ssim)
    found.backward()
    assert abs(found.item() - value.item()) < 1e-6
    # float32 sums of 11 x 11 products
    assert (render.grad - exact.grad).abs().max() < 1e-5 * exact.grad.abs().max()


def test_gradient_is_finite_on_flat_and_equal_images():
    for level in (0.0, 1.0):
        render = torch.full((20, 20, 3), level, requires_grad=True)
        photometric(render, torch.zeros(20, 20, 3), None, 0.2).backward()
        assert torch.isfinite(render.grad).all()


def test_masked_pixels_have_no_influence_and_no_gradient():
    render, target = images()
    mask = torch.zeros(40, 52, dtype=torch.bool)
    mask[5:30, 10:40] = True
    other = render.clone()
    other[~mask] = 0.1
    values = []
    for image in (render, other):
        image.requires_grad_(True)
        value = photometric(image, target, mask, 0.2)
        value.backward()
        assert (image.grad[~mask] == 0).all()
        values.append(value.item())
    assert values[0] == values[1]
    assert photometric(render, target, torch.zeros_like(mask), 0.2).item() == 0


def test_ssim_of_pictures_and_of_the_loss_is_its_published_formula():
    """Wang et al. 2004 by SciPy's Gaussian: window 11, σ 1.5, K1 = .01, K2 = .03, zeros outside."""
    rng = np.random.default_rng(0)
    a = rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)
    b = (0.6 * a + 0.4 * rng.integers(0, 255, a.shape)).astype(np.uint8)
    x, y = a / 255, b / 255

    def blur(values):
        return gaussian_filter(values, (1.5, 1.5, 0), mode="constant", radius=(5, 5, 0))

    means, variances = (blur(x), blur(y)), [blur(v * v) - blur(v) ** 2 for v in (x, y)]
    light = (2 * means[0] * means[1] + 1e-4) / (means[0] ** 2 + means[1] ** 2 + 1e-4)
    covariance = blur(x * y) - means[0] * means[1]
    expected = (light * (2 * covariance + 9e-4) / (sum(variances) + 9e-4)).mean()
    assert 0.2 < expected < 0.9
    assert ssim(a, b) == pytest.approx(expected, abs=1e-7)  # float32 taps
    loss = ssim_map(*(torch.from_numpy(image) for image in (x, y))).mean()
    assert ssim(a, b) == pytest.approx(float(loss), abs=1e-13)  # rounding
    assert abs(ssim(a, a) - 1) < 1e-12


def test_feature_distance_is_zero_for_the_pooled_render_and_ignores_masked_pixels():
    render = torch.rand(8, 12, 4, generator=torch.Generator().manual_seed(0))
    pooled = render.reshape(2, 4, 3, 4, 4).mean((1, 3))
    for kind in ("length", "l1"):
        assert feature_distance(render, pooled, None, kind).item() < 1e-6
    mask = torch.ones(8, 12, dtype=torch.bool)
    mask[:4, :4] = False
    pooled[0, 0] = 100
    for kind in ("length", "l1"):
        assert feature_distance(render, pooled, mask, kind).item() < 1e-6


@pytest.mark.parametrize(
    ("size", "cells"), [((24, 32), (6, 8)), ((25, 30), (6, 7)), ((9, 11), (9, 11))]
)
@pytest.mark.parametrize("counted", ["all alike", "some", "more or less"])
@pytest.mark.parametrize("kind", ["length", "l1"])
def test_fused_feature_distance_equals_the_oracle(size, cells, counted, kind):
    g = torch.Generator().manual_seed(0)
    render, target = torch.rand(*size, 5, generator=g), torch.rand(*cells, 5, generator=g)
    amounts = (torch.rand(size, generator=g) - 0.4).clamp_min(0)
    mask = {"all alike": None, "some": amounts > 0, "more or less": amounts}[counted]
    a, b = render.clone().requires_grad_(True), render.double().requires_grad_(True)
    value, exact = (
        feature_distance(a, target, mask, kind),
        feature_distance_reference(b, target.double(), mask, kind),
    )
    (3 * value).backward()
    (3 * exact).backward()
    assert abs(value.item() - exact.item()) < 1e-6
    torch.testing.assert_close(a.grad.double(), b.grad, rtol=1e-5, atol=1e-9)
