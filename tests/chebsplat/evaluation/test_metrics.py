"""Every metric on cases whose answer is worked out by hand."""

import numpy as np
import pytest

from chebsplat.evaluation.metrics import boundary_band, confusion, psnr, segmentation


def test_psnr_of_one_grey_level_is_48_13_db():
    image = np.full((4, 5, 3), 100, np.uint8)
    assert psnr(image + np.uint8(1), image) == pytest.approx(20 * np.log10(255))
    assert psnr(image, image) == np.inf
    with pytest.raises(ValueError, match="u8"):
        psnr(image.astype(float), image)


def test_segmentation_of_a_hand_worked_case():
    truth = np.array([0, 0, 0, 1, 1, -1])
    labels = np.array([0, 0, 1, 1, 2, 0])
    found = segmentation(confusion(labels, truth, 4))
    np.testing.assert_allclose(found.iou, [2 / 3, 1 / 3, 0, np.nan])
    assert found.miou == pytest.approx(1 / 3)
    assert found.macc == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert found.oa == pytest.approx(3 / 5)


def test_nothing_to_compare_is_nan_not_zero():
    assert np.isnan(segmentation(confusion(np.array([0]), np.array([-1]), 2)).miou)


def test_label_out_of_range_is_refused():
    with pytest.raises(ValueError, match="outside"):
        confusion(np.array([5]), np.array([0]), 2)


@pytest.mark.parametrize("half_width", [1, 2, 3])
def test_band_around_a_straight_edge_has_its_width(half_width):
    truth = np.zeros((9, 12), int)
    truth[:, 6:] = 1
    band = boundary_band(truth, half_width)
    assert (band == (np.abs(np.arange(12) - 5.5) < half_width)).all()


def test_ignored_pixels_make_no_boundary():
    truth = np.zeros((6, 6), int)
    truth[3] = -1
    assert not boundary_band(truth, 2).any()
