"""Colours of the Gaussians in view equal the plain-torch oracle, in value and gradient."""

import chebsplat  # noqa: F401  # isort: skip
import pytest
import torch

from chebsplat.sh import eval_sh, n_coefficients
from chebsplat.sh_kernels import colors_in_view
from chebsplat.sh_prune import masked_sh


def scene(held=15, n=60):
    g = torch.Generator().manual_seed(0)
    index = torch.randperm(n, generator=g)[:40]
    degrees = torch.randint(0, 4, (40, 1), generator=g)
    bands = (torch.arange(3) < degrees).float()
    parameters = [torch.randn(n, 1, 3, generator=g), torch.randn(n, held, 3, generator=g), bands]
    return parameters, index, torch.randn(n, 3, generator=g), torch.randn(3, generator=g)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_colors_equal_the_oracle(degree, masked):
    parameters, index, means, eye = scene()
    a = [p.clone().requires_grad_(True) for p in parameters]
    b = [p.double().requires_grad_(True) for p in parameters]
    fast = colors_in_view(a[0], a[1], a[2] if masked else None, index, means, eye, degree)
    shN = b[1][index][:, : n_coefficients(degree) - 1]
    shN = masked_sh(shN, b[2]) if masked and degree else shN
    exact = eval_sh(b[0][index], shN, means[index].double() - eye.double(), degree)
    torch.testing.assert_close(fast.double(), exact, rtol=0, atol=2e-6)
    weights = torch.randn(exact.shape, generator=torch.Generator().manual_seed(1))
    (fast * weights).sum().backward()
    (exact * weights).sum().backward()
    for x, y in zip(a, b, strict=True):
        expected = torch.zeros_like(y) if y.grad is None else y.grad
        found = torch.zeros_like(x) if x.grad is None else x.grad
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=2e-6)


def test_a_mask_that_no_longer_learns_gets_no_gradient_and_changes_none_of_the_others():
    parameters, index, means, eye = scene()
    learning, frozen = [[p.clone().requires_grad_(True) for p in parameters] for _ in range(2)]
    colors_in_view(*learning, index, means, eye, 3).sum().backward()
    colors_in_view(*frozen[:2], frozen[2].detach(), index, means, eye, 3).sum().backward()
    assert torch.equal(learning[0].grad, frozen[0].grad) and torch.equal(learning[1].grad, frozen[1].grad)
    assert frozen[2].grad is None and learning[2].grad.abs().sum() > 0


def test_too_few_coefficients_are_refused():
    parameters, index, means, eye = scene(held=3)
    assert colors_in_view(*parameters, index, means, eye, 1).shape == (40, 3)
    with pytest.raises(ValueError, match="degree 2 needs 8"):
        colors_in_view(*parameters, index, means, eye, 2)
