"""Means, spreads and paired differences, against values worked out by hand."""

import math

import numpy as np
import pytest

from chebsplat.evaluation.statistics import paired_difference, summarize


def test_spread_is_the_sample_deviation_and_unknown_of_one_value():
    found = summarize([1.0, 2.0, 3.0])
    assert (found.mean, found.spread, found.n) == (2.0, 1.0, 3)
    assert math.isnan(summarize([4.0]).spread)


def test_over_scenes_the_interval_counts_scenes_not_seeds():
    # a: +1, +3, mean 2; b: +4, +6, mean 5. Mean 3.5, deviation of {2, 5} 2.12132, error 1.5,
    # quantile 12.7062.
    found = paired_difference([11, 13, 14, 16], [10, 10, 10, 10], ["a", "a", "b", "b"])
    assert found.mean == 3.5
    assert found.error == pytest.approx(1.5)
    assert (found.low, found.high) == pytest.approx((3.5 - 19.0593, 3.5 + 19.0593), abs=1e-4)
    assert found.spread == pytest.approx(math.sqrt((2.5**2 + 0.5**2 + 0.5**2 + 2.5**2) / 3))
    assert (found.n_pairs, found.n_units, found.excluded) == (4, 2, False)


@pytest.mark.parametrize(
    ("steps", "excluded"), [((1, 2, 3), False), ((2, 3, 4), True), ((-2, -3, -4), True)]
)
def test_over_the_seeds_of_one_scene_an_interval_of_three_reaches_2_4841_deviations(
    steps, excluded
):
    found = paired_difference(np.array(steps), np.zeros(3), ["a"] * 3)
    assert found.high - found.mean == pytest.approx(4.30265 / math.sqrt(3), abs=1e-4)
    assert found.excluded is excluded


def test_scenes_weigh_alike_however_many_seeds_they_have():
    assert paired_difference([1, 1, 1, 5], np.zeros(4), ["a", "a", "a", "b"]).mean == 3.0


def test_ratios_have_the_geometric_mean_and_are_compared_with_one():
    found = paired_difference([2, 8], [1, 1], ["a", "b"], ratio=True)
    assert found.mean == pytest.approx(4)
    assert found.low * found.high == pytest.approx(16)
    assert not found.excluded
    assert paired_difference([0.5, 0.51], [1, 1], ["a", "b"], ratio=True).excluded


def test_one_pair_has_no_interval():
    found = paired_difference([3.0], [1.0], ["a"])
    assert found.mean == 2.0
    assert math.isnan(found.low)
    assert not found.excluded


@pytest.mark.parametrize(
    ("values", "baseline", "scenes", "ratio"),
    [
        ([], [], [], False),
        ([1.0], [1.0, 2.0], ["a"], False),
        ([math.nan], [1.0], ["a"], False),
        ([0], [1], ["a"], True),
    ],
)
def test_what_cannot_be_compared_is_an_error(values, baseline, scenes, ratio):
    with pytest.raises(ValueError, match=r"needed|values"):
        paired_difference(values, baseline, scenes, ratio)
