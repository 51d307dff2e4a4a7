"""Information outlives what labels are called, a changed quarter is found, and floors lie below
ceilings.
"""

import numpy as np
import pytest

from chebsplat.labels.plausible import QUARTERS, changes, information, sense, soft, spread

NAMES, INDOORS = (
    ["wall", "sky", "floor", "tree", "ceiling"],
    frozenset({"wall", "floor", "ceiling"}),
)


def one_hot(labels, n=5):
    return np.moveaxis(np.eye(n)[labels], -1, 1)


def test_information_is_of_what_is_the_same_in_both_and_not_of_its_name():
    said = np.random.default_rng(0).integers(0, 4, (2, 40, 40))
    told = one_hot(said)
    assert information(told, told) == pytest.approx(np.log(4), abs=0.01)
    assert information(told, one_hot((said + 1) % 5)) == pytest.approx(information(told, told))
    assert information(told, one_hot(np.random.default_rng(1).integers(0, 4, (2, 40, 40)))) < 0.01
    assert information(one_hot(0 * said), one_hot(0 * said)) == 0


def test_how_large_values_are_does_not_matter():
    values = np.random.default_rng(0).normal(size=(2, 5, 8, 8))
    assert np.allclose(soft(values, spread(values)), soft(255 * values + 3, spread(255 * values)))


@pytest.mark.parametrize("quarter", range(4))
def test_a_change_is_found_in_its_quarter(quarter):
    before = one_hot(np.zeros((1, 7, 9), int))
    after, row, column = before.copy(), slice(4, None) if quarter > 1 else slice(4), quarter % 2
    after[:, :, row, 5 * column : 5 + 4 * column] = one_hot(np.ones((1, 1, 1), int))
    assert QUARTERS[changes(before, after).argmax()] == QUARTERS[quarter]


def test_names_make_sense_where_floors_are_below_and_rooms_hold_what_is_seen():
    room = one_hot(np.repeat([4, 0, 0, 2], 2)[None, :, None].repeat(6, 2))
    assert sense(room, NAMES, INDOORS) == pytest.approx(1 + 4 * (2 * 0.4375 + 2 * 0.3125) / 8)
    assert sense(room[:, :, ::-1], NAMES, INDOORS) < 0.3  # upside down
    assert all(sense(room, list(np.roll(NAMES, by)), INDOORS) < 0.3 for by in (-1, 1))
