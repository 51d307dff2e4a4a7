"""What a scene means at points of space: every Gaussian that reaches has its share, and areas count
alike.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from chebsplat.evaluation.metrics import CELLS, REACH, features_at, thinned


def gaussians(n, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return (
        rng.random((n, 3)),
        quats,
        rng.uniform(0.01, 0.2, (n, 3)),
        rng.random(n),
        rng.normal(size=(n, 5)),
    )


def test_features_are_the_weighted_mean_over_all_gaussians():
    """Oracle: every pair by the inverse covariance. More Gaussians than are looked at together."""
    means, quats, scales, opacities, features = gaussians(3000)
    points = np.random.default_rng(1).uniform(-1, 2, (300, 3))
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    inverse = np.linalg.inv(np.einsum("nij,nj,nkj->nik", axes, scales**2, axes))
    away = points[:, None] - means
    squared = np.einsum("mni,nij,mnj->mn", away, inverse, away)
    peaks = opacities / scales.prod(1)
    weight = np.where(squared <= REACH**2, peaks[None] * np.exp(-squared / 2), 0)
    found, weights = features_at(points, means, quats, scales, opacities, features)
    np.testing.assert_allclose(weights, weight.sum(1), rtol=1e-6)
    reached = weights > 0
    assert 20 < reached.sum() < 280
    assert (
        np.abs(found[reached] - weight[reached] @ features / weight[reached].sum(1)[:, None]).max()
        < 1e-4
    )
    assert (found[~reached] == 0).all()


def test_a_small_gaussian_says_more_of_its_place_than_one_a_hundred_times_as_large_about_it():
    means, quats = np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))
    scales, opacities = np.array([[0.01] * 3, [1.0] * 3]), np.array([0.5, 0.9])
    points = np.array([[0, 0, 0], [0.1, 0, 0]])  # the second lies beyond the small one
    found, _ = features_at(points, means, quats, scales, opacities, np.eye(2))
    assert found[0, 0] > 0.99 and found[1].tolist() == [0, 1]


def test_a_point_beyond_every_gaussian_and_a_scene_of_none_have_no_weight():
    one = gaussians(1)
    far = one[0] + 10 * one[2].max()
    for found, weights in (features_at(far, *one), features_at(far, *(part[:0] for part in one))):
        assert (found.shape, weights.tolist()) == ((1, 5), [0])
    assert features_at(far[:0], *one)[0].shape == (0, 5)


def test_one_point_a_cell_is_kept_however_dense_they_lie_and_whatever_strays():
    rng = np.random.default_rng(0)
    dense, sparse = (
        rng.random((200_000, 3)) * [0.5, 1, 0],
        rng.random((50_000, 3)) * [0.5, 1, 0] + [0.5, 0, 0],
    )
    points = np.concatenate([dense, sparse, [[900.0, 0, 0]]])
    kept = thinned(points)
    left = (points[kept, 0] < 0.5).sum()
    assert abs(left / (len(kept) - left) - 1) < 0.05
    assert 0.9 < len(kept) / CELLS**2 < 1.1
    assert kept[-1] == len(points) - 1
    assert thinned(points[:1]).tolist() == [0]
    assert thinned(points[:0]).tolist() == []
