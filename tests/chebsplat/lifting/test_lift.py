"""The lift equals its float64 transcription for any number of threads; averages and evidence are
what they say.
"""

import numpy as np
import pytest
from raster import camera, scene
from thread_counts import assert_same_bits

from chebsplat.lifting.observations import Observations, estimate, gathered, halves_of, to_cells
from chebsplat.rasterize import reference
from chebsplat.rasterize.lift import Lifted, lift

N, CHANNELS, SIZE = 300, 19, (83, 61)  # cells are cut off on both sides


def arguments(seed=0, gate=0.1):
    gaussians = tuple(a.numpy() for a in scene(N, 1, seed)[:4])
    viewmats, K, *_ = camera(*SIZE)
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(16, 21, CHANNELS)).astype(np.float32)
    counts = (rng.random((16, 21)) * (rng.random((16, 21)) > 0.2)).astype(np.float32)
    values[counts == 0] = np.nan
    return gaussians, viewmats[0].numpy(), K[0].numpy(), SIZE, values, counts, gate


@pytest.mark.parametrize("gate", [0.0, 0.1, 0.5, 1.0])
def test_the_lift_of_a_view_equals_the_transcription(gate):
    given = arguments(gate=gate)
    found, (weights, sums) = lift(*given), reference.lift(*given)
    np.testing.assert_array_equal(found.ids, np.flatnonzero(weights))
    scale = weights.max()
    np.testing.assert_allclose(found.weights / scale, weights[found.ids] / scale, atol=1e-6)
    np.testing.assert_allclose(found.sums / scale, sums[found.ids] / scale, atol=1e-6)
    np.testing.assert_allclose(
        found.sums / found.weights[:, None], sums[found.ids] / weights[found.ids, None], atol=1e-5
    )


def test_the_lift_is_the_same_bits_for_any_number_of_threads():
    def lifted():
        views = [lift(*arguments(seed)) for seed in (0, 1)]
        assert len(views[0].ids) > 100
        return [*views[0], *vars(estimate(gathered(N, CHANNELS, views), 3, 0.1)).values()]

    assert_same_bits(lifted)


def test_a_gate_leaves_each_pixel_to_those_that_make_it_up():
    given = arguments(gate=0.0)
    weights = reference.pixel_weights(*given[:4])
    sums = [lift(*given[:6], gate).weights.sum() for gate in (0.0, 0.3, 1.0)]
    assert sums[0] > sums[1] > sums[2] > 0
    whole = (*given[:4], np.ones((16, 21, 1), np.float32), np.ones((16, 21), np.float32))
    assert lift(*whole, 1.0).weights.sum() == pytest.approx(weights.max(-1).sum(), rel=1e-5)
    assert lift(*whole, 0.0).weights.sum() == pytest.approx(weights.sum(), rel=1e-5)


def test_values_of_other_cells_than_the_view_has_are_refused():
    given = list(arguments())
    given[5] = given[5].copy()
    given[5][0, 0], given[4][0, 0] = 1, np.nan
    with pytest.raises(ValueError, match="not finite"):
        lift(*given)
    given[4] = given[4][1:]
    with pytest.raises(ValueError, match="have cells"):
        lift(*given)


def test_a_map_on_the_grid_of_cells_is_taken_as_it_is_and_zeros_say_nothing():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 5, 4)).astype(np.float16)
    features[0, 1], features[2, 2, 0] = 0, np.inf
    said, share = to_cells(features, np.full((3, 5), 0.5), (20, 12))
    expected = np.full((3, 5), 0.5)
    expected[0, 1] = expected[2, 2] = 0
    np.testing.assert_array_equal(share, expected)
    np.testing.assert_array_equal(said[share > 0], features[share > 0].astype(np.float32))
    mask = np.ones((12, 20), bool)
    mask[3, 3] = False
    assert to_cells(features, np.ones((3, 5)), (20, 12), mask)[1][0, 0] == 0


@pytest.mark.parametrize("shape", [(6, 10), (2, 5), (5, 3), (12, 20)])
def test_maps_of_other_grids_are_averaged_by_area(shape):
    rng = np.random.default_rng(1)
    width, height = 18, 11  # the last cells are 2 wide and 3 high
    features, counts = rng.normal(size=(*shape, 3)), rng.random(shape)
    said, share = to_cells(features.astype(np.float32), counts, (width, height))
    fine = 60  # samples a pixel, by which all edges are met exactly
    y = (np.arange(height * fine) + 0.5) * shape[0] / (height * fine)
    x = (np.arange(width * fine) + 0.5) * shape[1] / (width * fine)
    q = counts[y.astype(int)][:, x.astype(int)]
    b = features[y.astype(int)][:, x.astype(int)] * q[..., None]
    step = 4 * fine
    for i in range(3):
        for j in range(5):
            block = np.s_[i * step : (i + 1) * step, j * step : (j + 1) * step]
            assert share[i, j] == pytest.approx(q[block].mean(), rel=1e-5)
            np.testing.assert_allclose(
                said[i, j], b[block].mean((0, 1)) / q[block].mean(), rtol=1e-4, atol=1e-5
            )


def observations(seed=0, n=40, n_views=9):
    """Random observations of n Gaussians; the first has none."""
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(n_views):
        index = np.flatnonzero(rng.random(n) < 0.7)
        index = index[index > 0].astype(np.int32)
        weights = rng.random(len(index)).astype(np.float32) + 0.01
        sums = weights[:, None] * rng.normal([1, 0, 0, 0, 0], 0.3, (len(index), 5)).astype(
            np.float32
        )
        views.append(Lifted(index, weights, sums.astype(np.float32)))
    return gathered(n, 5, views)


def test_without_median_steps_features_are_weighted_means_with_their_evidence():
    given = observations()
    found = estimate(given, 0, 0.2)
    assert found.n_views[0] == found.weights[0] == found.agreement[0] == 0
    assert not found.features[0].any()
    for i in range(1, 40):
        rows = slice(*given.starts[i : i + 2])
        w, b, v = (a[rows].astype(np.float64) for a in (given.weights, given.means, given.views))
        assert list(v) == sorted(v)
        np.testing.assert_allclose(found.features[i], w @ b / w.sum(), rtol=1e-5, atol=1e-6)
        r = np.linalg.norm(w @ (b / np.linalg.norm(b, axis=1, keepdims=True))) / w.sum()
        assert found.agreement[i] == pytest.approx(r, abs=1e-6)
        assert found.n_views[i] == (w >= 0.2).sum() == found.half_views[:, i].sum()
        for half in (0, 1):
            mine = halves_of(int(given.views.max()) + 1)[given.views[rows]] == half
            expected = w[mine] @ b[mine] / w[mine].sum() if mine.any() else np.zeros(5)
            np.testing.assert_allclose(found.halves[half, i], expected, rtol=1e-5, atol=1e-6)


def test_median_steps_lower_the_sum_of_chords_and_leave_an_outlier_aside():
    given = observations(1)

    def chords(features):
        total = 0.0
        for i in range(1, 40):
            rows = slice(*given.starts[i : i + 2])
            u = given.means[rows] / np.linalg.norm(given.means[rows], axis=1, keepdims=True)
            x = features[i] / np.linalg.norm(features[i])
            total += given.weights[rows] @ np.linalg.norm(u - x, axis=1)
        return total

    costs = [chords(estimate(given, steps).features) for steps in (0, 1, 3, 10)]
    assert costs == sorted(costs, reverse=True)
    weights = np.array([1, 1, 1, 1.5], np.float32)
    means = np.array([[1, 0], [1, 0.01], [1, -0.01], [0, 1]], np.float32)
    one = Observations(np.array([0, 4]), np.arange(4, dtype=np.int32), weights, means)
    mean, median = (estimate(one, steps).features[0] for steps in (0, 5))
    assert mean[1] / mean[0] > 0.45
    assert median[1] / median[0] < 0.1
    assert (median >= 0).all()  # it stays between what the views say
