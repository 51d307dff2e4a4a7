"""Smoothing, blend, calibration and carrying over: transcriptions in float64, and what must hold at
the extremes.
"""

import math

import numpy as np
import pytest

from chebsplat.lifting.blend import (
    ALIKE,
    Shape,
    believed,
    blend,
    confidence,
    effective,
    errors_alike,
    familiar,
    halves_agree,
    labels_agree,
    reliable,
    start,
    strength_of,
    supported,
)
from chebsplat.lifting.observations import carry
from chebsplat.lifting.smoothing import (
    N_NEIGHBORS,
    PASSES,
    REACH,
    affinities,
    room_unit,
    smooth,
)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    n = 300
    means, normals = rng.uniform(0, 0.8, (n, 3)), unit(rng.normal((0, 0, 2), size=(n, 3)))
    colors = rng.uniform(0.4, 0.6, (n, 3))
    return means, normals, colors, rng.normal(size=(n, 5)), rng.integers(0, 9, n)


def transcribed(means, normals, colors, features, evidence, scale):
    """The formula of `smooth` over `affinities`, in Python floats."""
    smoothed = []
    for i in range(len(means)):
        offsets = (means - means[i]) / scale
        distances = np.linalg.norm(offsets, axis=1)
        nearest = [j for j in np.argsort(distances) if j != i and distances[j] <= REACH][
            :N_NEIGHBORS
        ]
        sums, total = evidence[i] * features[i], float(evidence[i])
        for j in nearest:
            angle = math.acos(min(abs(float(normals[i] @ normals[j])), 1.0))
            across, tone = (
                float(normals[i] @ offsets[j]),
                float(((colors[i] - colors[j]) ** 2).sum()),
            )
            exponent = (
                distances[j] ** 2 / 0.15**2
                + tone / 0.1**2
                + angle**2 / 0.5**2
                + across**2 / 0.03**2
            )
            weight = math.exp(-exponent / 2) * evidence[j]
            sums, total = sums + weight * features[j], total + weight
        smoothed.append(sums / total if total > 0 else features[i])
    return np.array(smoothed)


@pytest.mark.parametrize("scale", [1.0, 40.0])
def test_smoothing_is_its_formula_in_scenes_of_any_unit(scene, scale):
    means, normals, colors, features, evidence = scene
    near = affinities(means * scale + 7 * scale, normals, colors, scale)
    assert ((near.weights > 0).sum(1) == N_NEIGHBORS).any()
    expected = features
    for passes in range(1, PASSES + 1):
        expected = transcribed(means, normals, colors, expected, evidence, 1.0)
        found = smooth(features, evidence, near, passes)
        np.testing.assert_allclose(found, expected, atol=1e-5)  # float32 features and weights
    np.testing.assert_array_equal(smooth(features, evidence, near), found)
    assert np.abs(found - features).max() > 0.1


def test_smoothing_stops_at_colors_creases_and_steps():
    flat = np.stack([np.linspace(0, 0.2, 20), np.zeros(20), np.zeros(20)], 1)
    up, grey = np.tile([0.0, 0, 1], (20, 1)), np.full((20, 3), 0.5)
    second = np.arange(20) >= 10
    other = {
        "color": (flat, up, grey + 0.5 * second[:, None]),
        "normal": (flat, np.where(second[:, None], (1.0, 0, 0), up), grey),
        "plane": (flat + second[:, None] * (0, 0, 0.2), up, grey),
    }
    features = np.stack([~second, second], 1).astype(float)
    for what, given in other.items():
        found = smooth(features, np.ones(20), affinities(*given))
        assert np.abs(found - features).max() < 0.05, what
    assert np.abs(smooth(features, np.ones(20), affinities(flat, up, grey)) - features).max() > 0.2


@pytest.mark.parametrize("n", [0, 1, 2, 60])
@pytest.mark.parametrize("case", ["coincident", "far", "no evidence", "one color"])
def test_smoothing_is_finite_at_the_extremes(n, case):
    rng = np.random.default_rng(1)
    means = (
        np.full((n, 3), 1e3)
        if case == "coincident"
        else rng.normal(size=(n, 3)) * (1e6 if case == "far" else 1)
    )
    colors, normals = np.full((n, 3), 0.3), np.tile([0.0, 1, 0], (n, 1))
    features, evidence = (
        rng.normal(size=(n, 3)).astype(np.float32),
        np.full(n, float(case != "no evidence")),
    )
    assert np.isfinite(room_unit(means))
    assert room_unit(means) > 0
    found = smooth(features, evidence, affinities(means, normals, colors))
    assert found.shape == features.shape
    assert np.isfinite(found).all()
    if case == "coincident" and n == 2:
        np.testing.assert_allclose(found, np.tile(features.mean(0), (n, 1)), atol=1e-6)
    if case in ("far", "no evidence"):
        np.testing.assert_allclose(found, features, rtol=1e-6)


def test_what_no_view_sees_takes_what_its_neighbours_say_and_gives_nothing():
    means, normals = np.array([[0, 0, 0], [0.05, 0, 0.0]]), np.tile([0.0, 0, 1], (2, 1))
    found = smooth(
        np.array([[0.0, 9], [1, 0]]),
        np.array([0, 3]),
        affinities(means, normals, np.full((2, 3), 0.5)),
    )
    np.testing.assert_allclose(found, [[1, 0], [1, 0]], atol=1e-6)


def test_affinities_refuse_a_unit_that_is_none(scene):
    with pytest.raises(ValueError, match="positive unit"):
        affinities(*scene[:3], unit=0.0)


def test_views_that_err_alike_count_for_fewer():
    n = np.array([0, 1, 2, 6, 10_000])
    np.testing.assert_allclose(effective(n), [0, 1, 2 / 1.2, 3, 5], rtol=1e-3)


def views_of(n, n_blocks, shared, own, seed=0):
    """Agreement, halves and their views of 300 Gaussians seen by n views, in blocks of neighbours
    by turns; errors that a block shares and each view's own have these lengths.
    """
    rng = np.random.default_rng(seed)
    errors = own * rng.normal(size=(n, 300, 8)) / 8**0.5
    block = np.arange(n) // (n // n_blocks)
    errors += shared * rng.normal(size=(n_blocks, 300, 8))[block] / 8**0.5
    seen = unit((np.eye(8)[0] + errors).reshape(-1, 8)).reshape(n, 300, 8)
    halves = np.stack([seen[block % 2 == half].mean(0) for half in (0, 1)])
    n_views = np.stack([np.full(300, int((block % 2 == half).sum())) for half in (0, 1)])
    return np.linalg.norm(seen.mean(0), axis=1), halves, n_views


def test_errors_of_views_are_told_to_be_their_own_or_their_neighbours_too():
    assert errors_alike(*views_of(16, 4, 0.0, 0.7)) < 0.02
    assert 0.05 < errors_alike(*views_of(16, 4, 0.25, 0.6)) < 0.15
    assert errors_alike(*views_of(16, 4, 0.6, 0.3)) == ALIKE
    agreement, halves, n_views = views_of(16, 4, 0.0, 0.7)
    assert errors_alike(agreement, halves, np.minimum(n_views, 1)) == ALIKE  # nothing to tell by
    assert errors_alike(np.ones(300), halves[[0, 0]], n_views) == ALIKE  # no errors
    np.testing.assert_allclose(effective(np.array([1, 6, 100]), 0.0), [1, 6, 100])


def test_shape_counts_for_more_the_more_views_that_agree_contradict_it():
    rng = np.random.default_rng(2)
    shape = answering(np.eye(4)[rng.integers(0, 4, 3000)])
    wrong = rng.random(3000) < 0.3
    n = np.full(3000, 10)
    # of one mind, and each time wrong about the same things
    confident = np.where(wrong[:, None], np.roll(shape.answers, 1, 1), shape.answers)
    assert supported(confident, n, np.ones(3000), shape) == pytest.approx(0.7, abs=0.02)
    assert supported(shape.answers, n, np.ones(3000), shape) == 1
    # each view wrong about others, as often: the mean is right
    labels = np.where(
        rng.random((10, 3000)) < 0.3, rng.integers(0, 4, (10, 3000)), shape.answers.argmax(1)
    )
    means = np.eye(4)[labels].mean(0)
    assert supported(means, n, np.linalg.norm(means, axis=1), shape) > 1.2
    assert supported(0 * means, n, n, shape) == supported(means, n // 10, n, shape) == 1  # unknown
    least, most = strength_of(1.2, 1, 1), strength_of(0, 1, 1)
    assert least == strength_of(0.93, 1, 1) == 0.25 and most == 16
    assert strength_of(0.81, 1, 1) == pytest.approx(2)
    # an unsure teacher has its views count for less already
    assert strength_of(0.81, 0.5, 1) == pytest.approx(1) and strength_of(0.3, 0.01, 1) == 0.25
    assert strength_of(0.81, 1, 0.5) == pytest.approx(1) and strength_of(0, 1, 0) == 0


def test_shape_has_no_vote_where_views_tell_what_it_takes_for_the_same():
    (desk, keyboard, lamp), every = (labels := np.eye(3)), np.full(3, True)
    answers = np.stack([desk, desk, desk, lamp, 0.5 * desk]).astype(np.float32)
    seen = np.stack([desk, keyboard, lamp, keyboard, 2 * keyboard])
    blind = Shape(answers, labels, np.array([0, 0, 2]), every)  # a keyboard is a desk to it
    np.testing.assert_array_equal(blind.beside(seen).any(1), [True, False, True, True, False])
    np.testing.assert_array_equal(Shape(answers, labels, np.arange(3), every).beside(seen), answers)
    desks = Shape(answers, labels, np.array([1, 1, 2]), every)  # a desk is a keyboard to it
    given = Shape(np.tile(keyboard, (2, 1)), labels, desks.confused_with, every)
    np.testing.assert_array_equal(given.beside(np.stack([desk, 0 * desk])).any(1), [False, True])


def test_what_is_refined_lies_midway_between_trained_and_lifted_and_is_as_long_as_the_trained():
    trained, lifted = (
        np.array([[3.0, 0], [0, 2], [0, 0]], np.float32),
        np.array([[0, 0.1], [0, 0], [1, 0]], np.float32),
    )
    np.testing.assert_allclose(
        start("both", lifted, trained), [[3 / 2**0.5] * 2, [0, 2], [0, 0]], rtol=1e-6
    )
    assert start("trained", lifted, trained) is trained
    assert start("lifted", lifted, trained) is lifted and start("both", lifted, None) is lifted


def test_the_blend_counts_knowledge_as_so_many_views():
    f, g = (
        np.array([[1.0, 0], [1, 0], [1, 0], [1, 0]]),
        np.array([[0, 1.0], [0, 1], [0, 0], [0, 1]]),
    )
    n = effective(np.array([6, 0, 2, 1]))
    np.testing.assert_allclose(
        blend(f, n, g, 3.0), [[0.5, 0.5], [0, 1], [1, 0], [0.25, 0.75]], atol=1e-7
    )
    np.testing.assert_array_equal(blend(f, n, g, 0.0), f)
    unsure = blend(f, n, 0.5 * g, 3.0)  # counts for 3 / 8 of a view
    np.testing.assert_allclose(unsure[3], [1 / 1.375, 0.5 * 0.375 / 1.375], atol=1e-7)


def test_views_count_by_how_far_their_halves_agree():
    halves = np.array([[[1.0, 0], [1, 0], [2, 0], [0, 0]], [[1, 0], [0, 1], [1, 1], [1, 0]]])
    views = np.array([[2, 2, 2, 0], [1, 1, 1, 1]])
    mean = (1 + 0 + 0.5**0.5) / 3
    np.testing.assert_allclose(reliable(halves, views), [1, 0, 0.5**3, mean**6], rtol=1e-5)
    np.testing.assert_array_equal(reliable(halves, 0 * views), 1)


def test_views_of_a_scene_count_for_less_where_they_are_less_sure_of_labels_than_shape_is():
    labels = np.eye(3)
    sure, between = np.tile([1.0, 0, 0], (5, 1)), np.tile([1.0, 0.9, 0], (5, 1))
    assert familiar(sure, sure, labels) == familiar(sure, between, labels) == 1
    # of two labels; the third is far from both
    shares = [1 / (1 + np.exp(-0.1 / np.hypot(1, 0.9) / 0.1)), 1.0]
    assert familiar(between, sure, labels) == pytest.approx((shares[0] / shares[1]) ** 6, rel=5e-3)
    assert familiar(sure[:0], sure[:0], labels) == familiar(0 * sure, sure, labels) == 1
    half_seen = np.where(np.arange(5)[:, None] < 2, between, 0)
    # whom none sees says nothing
    assert familiar(half_seen, sure, labels) == familiar(between, sure, labels)


def test_confidence_grows_with_votes_that_agree_and_falls_where_they_do_not():
    f, n = np.tile([2.0, 0], (4, 1)), np.array([0, 1, 6, 6])
    alone = confidence(f, n, np.array([1, 1, 1, 0.5]))
    np.testing.assert_allclose(alone, [0, 1 / 2, 3 / 4, 1.5 / 4], atol=1e-6)
    same, other = (
        confidence(f, n, np.ones(4), np.tile(g, (4, 1)), 2.0) for g in ([1.0, 0], [0, 1.0])
    )
    np.testing.assert_allclose(same, [2 / 3, 3 / 4, 5 / 6, 5 / 6], atol=1e-6)
    assert (other[1:] < same[1:]).all()
    # shape alone is heard
    doubted = confidence(f, n, np.ones(4), np.tile([0, 1.0], (4, 1)), 2.0, worth=0.0)
    np.testing.assert_allclose(doubted, 2 / 3, atol=1e-6)
    nothing = confidence(f, n, np.ones(4), np.zeros((4, 2)), 2.0)
    np.testing.assert_allclose(nothing, [0, 1 / 2, 3 / 4, 3 / 4], atol=1e-6)


def answering(answers):
    """Shape that tells all four labels of `votes` apart."""
    return Shape(answers.astype(np.float32), np.eye(4), np.arange(4), np.full(4, True))


def votes(n_views, spread, seed=0, rare=0.5):
    """Halves of a plane of 400 Gaussians of two materials, what is true of them, and their
    affinities.
    """
    rng = np.random.default_rng(seed)
    means = np.concatenate([rng.uniform(0, 1, (400, 2)), np.zeros((400, 1))], 1)
    second = means[:, 0] > 1 - rare
    truth = np.eye(4)[second.astype(int)]
    halves = np.stack(
        [unit(truth + spread / np.sqrt(n_views) * rng.normal(size=truth.shape)) for _ in "ab"]
    )
    colors = np.where(second[:, None], 0.2, 0.8) * np.ones(3)
    near = affinities(means, np.tile([0.0, 0, 1], (400, 1)), colors)
    return halves.astype(np.float32), np.full((2, 400), n_views), truth, near


def test_halves_agree_better_smoothed_where_votes_are_noisy_and_not_where_neighbours_differ():
    halves, n_views, _, near = votes(2, 1.0)
    smoothed = [smooth(*of, near) for of in zip(halves, n_views, strict=True)]
    assert halves_agree(halves, n_views, smoothed) > halves_agree(halves, n_views) + 0.05
    # each Gaussian is something else, and all views agree on it
    own = np.tile(unit(np.random.default_rng(3).normal(size=(400, 4))), (2, 1, 1))
    smoothed = [smooth(*of, near) for of in zip(own, n_views, strict=True)]
    assert halves_agree(own, n_views, smoothed) < halves_agree(own, n_views) == pytest.approx(1)


def test_halves_are_compared_both_ways_where_both_see():
    halves, n_views, _, _ = votes(2, 1.0)
    n_views = n_views.copy()
    n_views[0, ::3] = 0  # of one half alone: not counted
    n_views[1, 1::3] = 6
    weights = n_views[:, n_views.all(0)]
    cosines = (unit(halves[0]) * unit(halves[1])).sum(1)[n_views.all(0)]
    expected = (weights * cosines).sum() / weights.sum()
    assert halves_agree(halves, n_views) == pytest.approx(expected, rel=1e-5)
    assert halves_agree(halves[::-1], n_views[::-1]) == pytest.approx(expected, rel=1e-5)
    assert halves_agree(halves, n_views, halves[::-1]) == pytest.approx(1)
    assert halves_agree(halves, n_views * np.array([[1], [0]])) == 0


def test_every_label_counts_alike_in_what_halves_have_alike():
    _, n_views, truth, _ = votes(2, 0.3, rare=0.05)
    rare = truth[:, 1] > 0
    assert 5 < rare.sum() < 40
    both, blind = np.stack([truth, truth]), np.eye(4)[np.zeros(400, int)]
    assert labels_agree(both, n_views, np.eye(4)) == 1
    assert labels_agree(both, n_views, np.eye(4), [blind, blind]) == pytest.approx(0.5)
    assert labels_agree(both, n_views, np.eye(4), [truth, blind]) == pytest.approx(0.75)
    assert labels_agree(both, n_views * np.array([[1], [0]]), np.eye(4)) is None


def test_carrying_over_is_its_formula(scene):
    means, normals, _, values, _ = scene
    points, point_normals, at, facing = means[:200], normals[:200], means[200:], normals[200:]
    found, distances = carry(values[:200], points * 3, point_normals, at * 3, facing, 3.0)
    for i in range(100):
        d = np.linalg.norm(points - at[i], axis=1)
        nearest = np.argsort(d)[:3]
        weights = np.maximum(np.abs(point_normals[nearest] @ facing[i]), 0.1) ** 2 / (
            d[nearest] ** 2 + 1e-4
        )
        # float32
        np.testing.assert_allclose(found[i], weights @ values[nearest] / weights.sum(), atol=1e-5)
        assert distances[i] == pytest.approx(3 * d.min(), rel=1e-5)


@pytest.mark.parametrize("n_points", [1, 2, 3])
def test_few_or_coincident_points_are_carried_over(n_points):
    values = np.eye(3)[:n_points]
    points, up = np.zeros((n_points, 3)), np.tile([0.0, 0, 1], (n_points, 1))
    found, _ = carry(values, points, up, np.zeros((4, 3)), np.tile([1.0, 0, 0], (4, 1)))
    np.testing.assert_allclose(found, np.tile(values.mean(0), (4, 1)), atol=1e-6)
    with pytest.raises(ValueError, match="no points"):
        carry(values[:0], points[:0], up[:0], np.zeros((4, 3)), np.zeros((4, 3)))


def test_a_room_has_about_its_own_unit():
    from chebsplat.synthetic.shuffled import build

    rng = np.random.default_rng(0)
    for preset, seed in (("office", 100), ("room", 200), ("shuffled", 301)):
        soup = build(preset, seed).soup
        corners = soup.vertices[soup.triangles].astype(np.float64)
        areas = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        chosen = corners[rng.choice(len(areas), 5000, p=areas / areas.sum())]
        means = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), 5000), chosen)
        assert room_unit(40 * means) == pytest.approx(40, rel=0.25)


def test_shape_is_believed_where_its_labels_are_a_knowing_teachers_or_the_teacher_is_unsure():
    rng = np.random.default_rng(0)
    codes, labels = np.eye(5, dtype=np.float32), rng.integers(0, 5, 2000)
    views, seen = codes[labels], np.full(2000, 3)
    for share, least, most in ((0.9, 1, 1), (0.65, 0.4, 0.6), (0.4, 0, 0)):
        said = np.where(rng.random(2000) < share, labels, (labels + 1) % 5)
        shape = Shape(codes[said], codes, np.arange(5), np.full(5, True))
        found = believed(views, seen, shape, worth=1.0)
        assert least <= found <= most
        assert believed(views, seen, shape, worth=0.1) == max(found, 0.9)
    assert believed(views, 0 * seen, shape, worth=1.0) == 1  # nobody to ask
    # what shape has no word for, it cannot be wrong about
    lost = labels == 4
    unanswered = Shape(codes[np.where(lost, 0, labels)], codes, np.arange(5), np.arange(5) < 4)
    assert believed(views, seen, unanswered, worth=1.0) == 1
    assert supported(views, seen, np.ones(2000), unanswered) == 1
