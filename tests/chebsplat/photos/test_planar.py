"""What has no texture goes on as the planes that are known of it, and no patch goes on into
another.
"""

import numpy as np
import pytest

from chebsplat.photos import planar

HEIGHT, WIDTH = 48, 64


@pytest.fixture
def corner():
    """Colours and depth of two walls that meet in the middle, of colours that differ little, before
    a floor.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    depth = np.where(x < WIDTH / 2, 1 / (0.2 + 0.004 * x), 1 / (0.2 + 0.004 * (WIDTH - x)))
    colors = np.where((x < WIDTH / 2)[..., None], [0.70, 0.70, 0.68], [0.64, 0.64, 0.62])
    floor = y > 36
    depth = np.where(floor, 1 / (0.1 + 0.006 * y), depth)
    return np.where(floor[..., None], [0.5, 0.3, 0.2], colors), depth


def holes(depth, rng, share):
    known = rng.random(depth.shape) < share
    known[10:30, 5:25] = known[8:30, 40:58] = False
    return np.where(known, depth, 0)


def test_planes_fill_their_patches_and_what_was_known_stays(corner):
    colors, depth = corner
    given = holes(depth, np.random.default_rng(0), 0.3)
    filled = planar.completed(given, colors)
    np.testing.assert_allclose(filled, depth, rtol=1e-4)
    assert (filled[given > 0] == given[given > 0].astype(np.float32)).all()


def test_slow_shades_do_not_bound_a_patch_and_edges_do(corner):
    colors, _ = corner
    shaded = colors + np.linspace(0, 0.3, WIDTH)[None, :, None] * [1, 1, 1]
    label = planar.patches(shaded)
    assert len(np.unique(label)) == 3
    assert len({label[0, 0], label[0, -1], label[-1, 0]}) == 3


def test_wrong_pixels_and_two_planes_of_one_colour_do_not_mislead(corner):
    colors, depth = corner
    rng = np.random.default_rng(1)
    # both walls alike: one patch of two planes
    colors = np.where((colors[..., :1] > 0.6), 0.7, colors)
    given = holes(depth, rng, 0.4)
    wrong = (rng.random(depth.shape) < 0.15) & (given > 0)
    given[wrong] *= rng.uniform(0.6, 0.9, wrong.sum())
    filled = planar.completed(given, colors)
    missing = given == 0
    off = np.abs(filled / depth - 1)[missing]
    assert np.quantile(off, 0.95) < 0.02


def test_a_patch_of_which_little_or_no_plane_is_known_stays_unknown(corner):
    colors, depth = corner
    given = np.zeros_like(depth)
    assert not planar.completed(given, colors).any()
    given[:3, :3] = depth[:3, :3]  # nine pixels
    assert (planar.completed(given, colors) > 0).sum() == 9
    rng = np.random.default_rng(2)
    noise = np.where(rng.random(depth.shape) < 0.3, rng.uniform(1, 9, depth.shape), 0)
    assert ((planar.completed(noise, colors) > 0) == (noise > 0)).mean() > 0.95


def test_a_plane_that_would_lie_behind_the_camera_is_no_depth():
    """A wall so slanted that its plane meets the horizon within the patch."""
    x = np.arange(WIDTH)[None].repeat(HEIGHT, 0)
    inverse = 0.3 - 0.01 * x
    given = np.where((inverse > 0.15), 1 / np.where(inverse > 0, inverse, 1), 0)
    filled = planar.completed(given, np.full((HEIGHT, WIDTH, 3), 0.5))
    assert np.isfinite(filled).all()
    assert (filled[:, 31:] == 0).all()
    assert (filled[:, 20:29] > 0).all()
