"""Colours of the Gaussians in view equal the plain-torch oracle, in value and gradient."""

import chebsplat  # noqa: F401  # isort: skip
import pytest
import torch

from chebsplat.splats.sh import colors_in_view, eval_sh, n_coefficients
from chebsplat.splats.sh_kernels import colors_by_degree
from chebsplat.training.sh_prune import dense, masked_sh


def scene(held=(60, 60, 60, 60)):
    """Coefficients by band of the first held[l] of 60 Gaussians, and nested masks of the 40 in
    view.
    """
    g = torch.Generator().manual_seed(0)
    index = torch.randperm(60, generator=g)[:40]
    masks = (torch.arange(3) < torch.randint(0, 4, (40, 1), generator=g)).float()
    parameters = [torch.randn(n, 2 * band + 1, 3, generator=g) for band, n in enumerate(held)] + [
        masks
    ]
    return parameters, index, torch.randn(60, 3, generator=g), torch.randn(3, generator=g)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("held", [(60, 60, 60, 60), (60, 31, 30, 2), (60, 60, 0, 0)])
def test_colors_equal_the_oracle(degree, masked, held):
    parameters, index, means, eye = scene(held)
    a = [p.clone().requires_grad_(True) for p in parameters]
    b = [p.double().requires_grad_(True) for p in parameters]
    fast = colors_in_view(a[:4], a[4] if masked else None, index, means, eye, degree)
    shN = dense(b[1:4], 60)[index][:, : n_coefficients(degree) - 1]
    shN = masked_sh(shN, b[4]) if masked and degree else shN
    exact = eval_sh(b[0][index], shN, means[index].double() - eye.double(), degree)
    torch.testing.assert_close(fast.double(), exact, rtol=0, atol=2e-6)
    weights = torch.randn(exact.shape, generator=torch.Generator().manual_seed(1))
    (fast * weights).sum().backward()
    (exact * weights).sum().backward()
    for x, y in zip(a, b, strict=True):
        expected = torch.zeros_like(y) if y.grad is None else y.grad
        found = torch.zeros_like(x) if x.grad is None else x.grad
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize("value", [-0.2, 0.0])
def test_a_colour_cut_off_at_black_is_lifted_and_never_lowered(value, backend):
    sh0 = torch.full((2, 1, 3), (value - 0.5) / 0.28209479177387814).requires_grad_(True)
    index, means, eye = torch.arange(2), torch.ones(2, 3), torch.zeros(3)
    colors = colors_in_view([sh0], None, index, means, eye, 0, backend)
    assert colors.abs().max() < 1e-7
    (colors * torch.tensor([[-1.0], [1.0]])).sum().backward()
    torch.testing.assert_close(sh0.grad[0], torch.full((1, 3), -0.28209479177387814))
    # rounding decides on which side of 0 the other one is
    assert value == 0 or not sh0.grad[1].any()


def test_a_mask_that_no_longer_learns_gets_no_gradient_and_changes_none_of_the_others():
    parameters, index, means, eye = scene()
    learning, frozen = [[p.clone().requires_grad_(True) for p in parameters] for _ in range(2)]
    colors_in_view(learning[:4], learning[4], index, means, eye, 3).sum().backward()
    colors_in_view(frozen[:4], frozen[4].detach(), index, means, eye, 3).sum().backward()
    assert all(torch.equal(a.grad, b.grad) for a, b in zip(learning[:4], frozen[:4], strict=True))
    assert frozen[4].grad is None and learning[4].grad.abs().sum() > 0


def test_a_band_that_is_not_used_gets_no_gradient():
    parameters, index, means, eye = scene()
    bands = [p.clone().requires_grad_(True) for p in parameters[:4]]
    colors_in_view(bands, None, index, means, eye, 1).sum().backward()
    assert [band.grad is not None for band in bands] == [True, True, False, False]
    with pytest.raises(ValueError, match="degree 4"):
        colors_in_view(bands, None, index, means, eye, 4)


def test_a_gaussian_shows_the_bands_of_its_own_degree_alone():
    generator = torch.Generator().manual_seed(0)
    n = 40
    sh0, shN = (torch.randn(n, k, 3, generator=generator) for k in (1, 15))
    degrees, means = torch.arange(n) % 4, torch.randn(n, 3, generator=generator)
    index, eye = torch.randperm(n, generator=generator)[:25], torch.tensor([0.1, 0.2, 3.0])
    colors = colors_by_degree(sh0, shN, degrees, index, means, eye)
    for i, color in zip(index.tolist(), colors, strict=True):
        degree = int(degrees[i])
        one = slice(i, i + 1)
        torch.testing.assert_close(color, eval_sh(sh0[one], shN[one], means[one] - eye, degree)[0])
