"""Lessons are sums: exact without their points, in any order, and gone without a trace when they
are forgotten.
"""

import math

import numpy as np
import pytest

from chebsplat.errors import DataFailure
from chebsplat.shape.lessons import (
    KAPPA,
    RIDGE,
    SHIPPED_WORTH,
    basis,
    class_means,
    combined,
    mapped,
    novelty,
    odds,
    scale_of,
    scaled_novelty,
    solved,
    summed,
    unexplained,
)

P, D = 9, 4


def points(seed, n=200, kinds=P):
    """z [n, P] of features of the first `kinds`, the last always 1; y of one map for all, with
    noise; w.
    """
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(n, P)) * (np.arange(P) < kinds)
    z[:, -1] = 1
    y = z @ np.random.default_rng(99).normal(size=(P, D)) + 0.3 * rng.normal(size=(n, D))
    return z, y, rng.uniform(0, 3, n)


def test_the_mean_of_each_class_is_had_from_the_sums_alone():
    z, _, w = points(0)
    words = np.random.default_rng(5).normal(size=(4, 6))
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    labels = np.random.default_rng(6).choice([0, 1, 3], len(z))
    means, present = class_means(summed(z, words[labels], w), words)
    assert list(present) == [0, 1, 3]
    expected = [np.average(z[labels == k], axis=0, weights=w[labels == k]) for k in present]
    np.testing.assert_allclose(means, expected, atol=1e-9)


def test_what_a_map_leaves_unexplained_is_that_of_the_points():
    z, y, w = points(0)
    sums, found = summed(z, y, w), np.random.default_rng(1).normal(size=(P, D))
    left = (w @ ((y - z @ found) ** 2).sum(1)) / (w @ (y**2).sum(1))
    assert unexplained(sums, found) == pytest.approx(left)
    assert unexplained(sums, np.zeros((P, D))) == 1
    exact = summed(z, z @ found, w)
    assert unexplained(exact, found) == pytest.approx(0, abs=1e-12)


def test_sums_answer_as_the_points_do():
    z, y, w = points(0)
    sums, w1 = summed(z, y, w), w / w.sum()
    root = np.sqrt(w)[:, None]
    np.testing.assert_allclose(
        solved(sums, 1e-14), np.linalg.lstsq(root * z, root * y)[0], rtol=1e-9
    )
    for ridge in (1e-3, 0.1):
        A = (w1[:, None] * z).T @ z
        wanted = np.linalg.inv(A + ridge * np.diag(np.diag(A))) @ (w1[:, None] * z).T @ y
        np.testing.assert_allclose(solved(sums, ridge), wanted, rtol=1e-10)
    mean = (w1[:, None] * y).sum(0)
    assert sums.spread() == pytest.approx(
        math.sqrt((w1 * ((y - mean) ** 2).sum(1)).sum()), rel=1e-10
    )
    for weights in (0 * w, np.zeros(0)):
        with pytest.raises(ValueError, match="no point has a weight"):
            summed(z[: len(weights)], y[: len(weights)], weights)


def test_features_that_are_zero_everywhere_have_no_say():
    z, y, w = points(1, kinds=6)
    sums, alive = summed(z, y, w), [*range(6), P - 1]
    found = solved(sums, 1e-2)
    assert not found[6 : P - 1].any()
    np.testing.assert_allclose(found[alive], solved(summed(z[:, alive], y, w), 1e-2), rtol=1e-12)
    scale = scale_of(sums)
    assert np.flatnonzero(scale == 0).tolist() == [6, 7]
    assert novelty(sums, scale, basis(sums, scale)) < 0.1  # finite, and known


def test_what_ships_counts_for_so_many_scenes_and_the_order_of_lessons_is_no_matter():
    lessons, trust = [summed(*points(k)) for k in range(12)], [1.0, 0.5, 0.25] * 4
    found = mapped(lessons[:2], lessons, trust)
    for seed in (0, 1):
        order = np.random.default_rng(seed).permutation(12)
        again = mapped(lessons[:2], [lessons[k] for k in order], [trust[k] for k in order])
        np.testing.assert_allclose(again, found, rtol=0, atol=1e-12 * abs(found).max())
    one = mapped(lessons[:2], lessons[2:3], [0.5])
    wanted = solved(combined(lessons[:3], [SHIPPED_WORTH / 2, SHIPPED_WORTH / 2, 0.5]), RIDGE)
    np.testing.assert_allclose(one, wanted, rtol=1e-10)


def test_novelty_is_none_within_what_is_known_and_whole_outside():
    def along(axes):
        z = np.zeros((3 * len(axes), P))
        z[np.arange(len(z)), np.tile(axes, 3)] = 1
        return summed(z, np.zeros((len(z), D)), np.ones(len(z)))

    scale = np.ones(P)
    known = basis(along([0, 1, 2]), scale)
    assert known.shape == (P, 3)
    np.testing.assert_allclose(known.T @ known, np.eye(3), atol=1e-12)
    assert novelty(along([0, 2]), scale, known) == pytest.approx(0, abs=1e-7)
    assert novelty(along([5, 6]), scale, known) == pytest.approx(1)
    assert novelty(along([0, 5]), scale, known) == pytest.approx(math.sqrt(0.5))
    assert scaled_novelty(0.5, 2.0) == 0.5 * (1 + 2 * KAPPA)


def test_rare_things_teach_more_and_what_one_view_saw_nothing():
    found = odds(np.array([3] * 90 + [3] * 9 + [1]), np.array([0] * 90 + [1] * 9 + [2]))
    # half alike; half by 1 / √90 and 1 / √9, which sum to √90 + √9
    rare = np.repeat([90**-0.5, 1 / 3], [90, 9]) / (90**0.5 + 3)
    np.testing.assert_allclose(found, [*(0.5 / 99 + 0.5 * rare), 0])
    unseen = odds(np.array([3] * 99 + [1] * 900), np.array([0] * 90 + [1] * 9 + [0] * 900))
    np.testing.assert_allclose(unseen[:99], found[:99])
    with pytest.raises(DataFailure, match="seen in 2 views"):
        odds(np.ones(3, int), np.zeros(3, int))
