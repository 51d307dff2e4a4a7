"""Fused features in view equal the plain-torch oracle, in value and gradient, and are the same bits for any threads."""

import chebsplat  # noqa: F401  # isort: skip
import pytest
import torch
from thread_counts import assert_same_bits

from chebsplat.shape.fusion import Gate, fuse_in_view, propagate


def scene(channels, n=400, m=20, n_fresh=6):
    g = torch.Generator().manual_seed(channels)
    gate = Gate(channels)
    with torch.no_grad():
        gate.linear.weight.copy_(torch.randn(channels, 2 * channels, generator=g) * 0.3)
    cover = torch.randint(0, m, (n, 3), generator=g)
    cover[:, 2] = torch.where(torch.rand(n, generator=g) < 0.5, -1, cover[:, 2])
    cover[::7] = -1
    weights = torch.where(cover >= 0, torch.rand(n, 3, generator=g), 0.0)
    cache, chosen = torch.randn(m, channels, generator=g), torch.randperm(m, generator=g)[:n_fresh]
    leaves = torch.randn(n, channels, generator=g), torch.randn(n_fresh, channels, generator=g)
    index = torch.randperm(n, generator=g)[: n // 2]
    upper = torch.randn(len(index), channels, generator=g)
    return gate, leaves, (cache, chosen), (cover, weights, index), upper


def fused(gate, leaves, held, where, upper):
    features, fresh = (leaf.clone().requires_grad_(True) for leaf in leaves)
    gate.zero_grad()
    out = fuse_in_view(gate, features, (held[0], fresh, held[1]), *where)
    out.backward(upper)
    return [out.detach(), features.grad, fresh.grad, gate.linear.weight.grad, gate.linear.bias.grad]


@pytest.mark.parametrize("channels", [1, 8, 13, 16, 17, 32])
def test_fused_features_equal_the_oracle(channels):
    gate, leaves, held, where, upper = scene(channels)
    found = [value.clone() for value in fused(gate, leaves, held, where, upper)]
    exact = gate.double()
    exact.zero_grad()
    features, fresh = (leaf.double().requires_grad_(True) for leaf in leaves)
    cover, weights, index = where
    shape = propagate(held[0].double().index_copy(0, held[1], fresh), cover[index], weights[index].double())
    out, _ = exact(features[index], shape, cover[index, 0] >= 0)
    out.backward(upper.double())
    wanted = [out.detach(), features.grad, fresh.grad, exact.linear.weight.grad, exact.linear.bias.grad]
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=2e-5, atol=2e-5)


def test_threads_do_not_change_a_bit():
    case = scene(13, n=3000)
    assert_same_bits(lambda: [value.clone() for value in fused(*case)])


def test_nothing_in_view_and_no_fresh_region():
    gate, leaves, held, (cover, weights, index), _ = scene(13)
    features = leaves[0].clone().requires_grad_(True)
    none = torch.zeros(0, dtype=torch.int64)
    out = fuse_in_view(gate, features, (held[0], leaves[1][:0], none), cover, weights, none)
    assert out.shape == (0, 13)
    out = fuse_in_view(gate, features, (held[0], leaves[1][:0], none), cover, weights, index)
    out.sum().backward()
    assert torch.isfinite(features.grad).all()
