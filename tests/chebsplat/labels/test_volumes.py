"""Points take the label of the volume that holds them."""

import numpy as np
import pytest

from chebsplat.labels.volumes import holder, prism

SQUARE = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
VOLUMES = [prism(SQUARE / 2, 0.5, 1.0), prism(SQUARE, 0.0, 1.0),
           prism(SQUARE + np.array([2.1, 0]), 0.0, 1.0)]  # fmt: skip


@pytest.mark.parametrize(
    ("point", "held"),
    [
        ((1.5, 1.5, 0.5), 1), ((0.5, 0.5, 0.75), 0), ((1.04, 0.5, 0.75), 1), ((2.02, 1, 0.5), 1),
        ((2.08, 1, 0.5), 2),
        ((1, 1, -0.05), 1), ((1, 1, -0.07), -1), ((-0.05, -0.05, 0.2), 1), ((np.nan, 1, 0.5), -1),
    ],
)  # fmt: skip
def test_a_point_has_the_first_volume_about_it_or_else_the_nearest_within_the_margin(point, held):
    assert holder(np.array([[9.0, 9, 9], point]), VOLUMES, 0.06).tolist() == [-1, held]


def test_a_triangle_holds_the_share_of_its_box_that_it_fills():
    points = np.random.default_rng(0).uniform(size=(4000, 3))
    held = holder(points, [prism(np.array([[0.0, 0], [0, 1], [1, 0]]), 0.0, 0.5)], 0.0) == 0
    np.testing.assert_array_equal(held, (points[:, :2].sum(1) <= 1) & (points[:, 2] <= 0.5))


@pytest.mark.parametrize(
    ("corners", "bottom", "top", "why"),
    [
        (SQUARE, 1.0, 1.0, "no volume"), (SQUARE, 1.0, 0.0, "no volume"),
        (SQUARE[:2], 0.0, 1.0, "no volume"),
        (SQUARE * [1, 0], 0.0, 1.0, "no volume"),
        ([*SQUARE.tolist(), [0.5, 1]], 0.0, 1.0, "not convex"),
    ],
)  # fmt: skip
def test_what_is_flat_or_not_convex_is_refused(corners, bottom, top, why):
    with pytest.raises(ValueError, match=why):
        prism(np.array(corners), bottom, top)
