"""Depth of the surface equals its transcription, and lies where most of a pixel's light comes
from.
"""

import numpy as np
import pytest
from raster import camera, scene
from thread_counts import assert_same_bits

from chebsplat.rasterize import reference
from chebsplat.rasterize.depths import depths

N, SIZE = 300, (83, 61)


def arguments():
    gaussians = tuple(a.numpy() for a in scene(N, 1, 0)[:4])
    viewmats, K, *_ = camera(*SIZE)
    planes = (
        np.random.default_rng(0).normal((0, 0, 0.5), (1e-3, 1e-3, 0.1), (N, 3)).astype(np.float32)
    )
    return gaussians, viewmats[0].numpy(), K[0].numpy(), SIZE, planes


def ordered(gaussians, viewmat):
    """Rows of Gaussians, front to back."""
    return np.argsort(gaussians[0].astype(np.float64) @ viewmat[2, :3], kind="stable")


@pytest.mark.parametrize("part", [(0.0, 1.0), (0.7, 0.9), (0.2, 0.3)])
def test_the_depth_of_a_view_equals_the_transcription(part):
    gaussians, viewmat, K, size, planes = arguments()
    found, covered = depths(gaussians, viewmat, K, size, planes, part)
    weights = reference.pixel_weights(gaussians, viewmat, K, size)
    order = ordered(gaussians, viewmat)
    passed = weights[..., order].cumsum(-1)
    low, high = (bound * passed[..., -1:] for bound in part)
    within = np.clip(passed, low, high) - np.clip(passed - weights[..., order], low, high)
    y, x = np.indices(found.shape) + 0.5
    inverse = np.stack([x, y, np.ones_like(x)], -1) @ planes[order].T.astype(np.float64)
    total, summed = within.sum(-1), (within * inverse).sum(-1)
    np.testing.assert_allclose(covered, passed[..., -1], atol=1e-5)
    sure = (total > 1e-3) & (summed > 1e-3)  # elsewhere a rounding decides whether there is a depth
    assert sure.mean() > 0.25
    np.testing.assert_allclose(1 / found[sure], summed[sure] / total[sure], rtol=2e-3)
    assert np.isinf(found[total < 1e-7]).all()


def test_the_depth_is_the_same_bits_for_any_number_of_threads():
    assert_same_bits(lambda: depths(*arguments()))


def test_a_wall_of_faint_gaussians_is_met_where_they_are_densest():
    rng = np.random.default_rng(0)
    n, wall = 4000, 2.0
    means = np.stack([*rng.uniform(-1.5, 1.5, (2, n)), wall - rng.exponential(0.05, n)], 1).astype(
        np.float32
    )
    gaussians = means, np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), 0.05, np.float32)
    K = np.array([[60.0, 0, 30], [0, 60.0, 30], [0, 0, 1]])
    planes = np.zeros((n, 3), np.float32)
    planes[:, 2] = 1 / means[:, 2]
    shown = (*gaussians, np.full(n, 0.25, np.float32)), np.eye(4), K, (60, 60), planes
    mean, late = (depths(*shown, part)[0] for part in ((0.0, 1.0), (0.7, 0.9)))
    assert np.abs(np.median(late) - wall) < 0.5 * np.abs(np.median(mean) - wall)
