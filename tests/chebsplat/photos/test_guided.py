"""Matches along epipolar lines: those of a search by the same rules, true ones, none without a
line.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chebsplat.photos.guided import ALIKE, BAND, RATIO, along_lines, fundamental, sampson_distance
from tests.stages.reconstruction.test_adjustment import poses_of

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def seen(shift, n=600, noise=6, seed=0):
    """Two views of random points, half of them in one alone: pixels, descriptors, F and the true
    partners.
    """
    rng = np.random.default_rng(seed)
    poses = poses_of(
        Rotation.from_rotvec([[0, 0, 0], [0.02, 0.05, 0.1]]).as_matrix(),
        np.array([[0.0, 0, 0], shift]),
    )
    points = rng.uniform([-1, -0.8, 3], [1, 0.8, 6], (n, 3))
    camera = [(points @ pose[:3, :3].T + pose[:3, 3]) @ K.T for pose in poses]
    first, second = ((at[:, :2] / at[:, 2:]).astype(np.float32) for at in camera)
    own = rng.integers(0, 120, (n, 128))
    theirs = np.clip(own + rng.integers(-noise, noise + 1, own.shape), 0, 255)
    order = rng.permutation(n)
    second, theirs = second[order], theirs[order]
    lost = rng.random(n) < 0.5
    theirs[lost] = rng.integers(0, 120, (lost.sum(), 128))
    truth = np.where(lost, -1, order)  # of each of the second view's features, the first view's
    return (
        (first, second),
        (own.astype(np.uint8), theirs.astype(np.uint8)),
        fundamental(K, poses[0], K, poses[1]),
        truth,
    )


def searched(pixels, descriptors, F):
    """The same rules, every feature with every other one."""
    one, other = (some.astype(np.float32) for some in descriptors)
    cosine = (one @ other.T) / np.outer(np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1))
    n, m = cosine.shape
    pairs = np.indices((n, m)).reshape(2, -1)
    misses = sampson_distance(
        F, pixels[0][pairs[0]].astype(float), pixels[1][pairs[1]].astype(float)
    )
    cosine = np.where(misses.reshape(n, m) <= BAND, cosine, -1)
    best, mutual = cosine.argmax(1), cosine.argmax(0)[cosine.argmax(1)] == np.arange(n)
    top = np.sort(cosine, 1)
    fits = (top[:, -1] > ALIKE) & (1 - top[:, -1] < RATIO**2 * (1 - top[:, -2])) & mutual
    return np.stack([np.flatnonzero(fits), best[fits]], 1)


@pytest.mark.parametrize(
    "shift", [[0.5, 0, 0], [0, 0.5, 0], [0.1, 0.2, 0.6]], ids=["aside", "up", "ahead"]
)
def test_matches_are_those_of_a_search_of_all_features_and_true(shift):
    pixels, descriptors, F, truth = seen(shift)
    (found,) = along_lines(pixels, descriptors, np.array([[0, 1]]), F[None])
    np.testing.assert_array_equal(found, searched(pixels, descriptors, F))
    wrong = truth[found[:, 1]] != found[:, 0]
    assert wrong.mean() < 0.02
    assert len(found) > 0.9 * (truth >= 0).sum()


def test_pairs_are_matched_each_by_itself_and_in_any_order():
    pixels, descriptors, F, _ = seen([0.5, 0, 0])
    both = along_lines(pixels, descriptors, np.array([[0, 1], [1, 0]]), np.stack([F, F.T]))
    forth, back = both
    np.testing.assert_array_equal(forth, back[:, ::-1][np.argsort(back[:, 1])])


def test_lines_elsewhere_leave_few_matches():
    pixels, descriptors, F, truth = seen([0.5, 0, 0])
    (found,) = along_lines(
        (pixels[0], pixels[1] + np.float32([0, 25])), descriptors, np.array([[0, 1]]), F[None]
    )
    assert len(found) < 0.05 * (truth >= 0).sum()


def test_no_line_and_no_feature_give_no_match():
    pixels, descriptors, F, _ = seen([0.5, 0, 0])
    nothing = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    views, texts = (*pixels, nothing[0]), (*descriptors, nothing[1])
    lines = np.stack([np.zeros((3, 3)), F, F])
    for found in along_lines(views, texts, np.array([[0, 1], [0, 2], [2, 1]]), lines):
        assert found.shape == (0, 2)
