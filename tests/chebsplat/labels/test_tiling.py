"""Maps of windows make one map of the whole image."""

import itertools

import numpy as np
import pytest

from chebsplat.labels.tiling import OVERLAP, blended, sampling, window_starts


@pytest.mark.parametrize(
    ("length", "window"), [(480, 480), (481, 480), (300, 480), (520, 480), (1000, 480), (97, 12)]
)
def test_windows_cover_an_axis_and_overlap(length, window):
    starts = window_starts(length, window)
    assert starts[0] == 0
    assert length <= starts[-1] + window
    assert starts[-1] == max(length - window, 0)
    assert all(b - a <= window * (1 - OVERLAP) + 1 for a, b in itertools.pairwise(starts))


@pytest.mark.parametrize(("length", "window"), [(481, 480), (640, 480), (1000, 480)])
def test_weights_of_neighbours_add_up_to_one_where_two_overlap(length, window):
    starts = window_starts(length, window)
    rows = [sampling(length, length, starts, k, window, window) for k in range(len(starts))]
    total = sum(row.sum(1) for row in rows)
    cover = sum((row.sum(1) > 0).astype(int) for row in rows)
    assert np.allclose(total[cover <= 2], 1, atol=1e-5)
    assert (total > 0.5).all()


def field(y, x):
    """A smooth map [H, W, 2]."""
    y, x = y[:, None], x[None]
    return np.stack([np.sin(x / 19) + y / 30, np.cos(y / 13) + x / 40], -1)


@pytest.mark.parametrize("size", [(48, 64), (56, 96), (100, 130), (30, 90)])
@pytest.mark.parametrize("stride", [1, 4])
def test_a_field_seen_through_windows_is_the_field(size, stride):
    window, grid = (48, 64), tuple(-(-n // 4) for n in size)

    def encode(top, left):
        rows, columns = (np.arange(side // stride) * stride + stride / 2 for side in window)
        return field(top + rows, left + columns).transpose(2, 0, 1)

    found = blended(encode, size, window, grid)
    truth = field(*((np.arange(n) + 0.5) * side / n for n, side in zip(grid, size, strict=True)))
    error = np.abs(found - truth)
    # at the border there is no cell beyond the last to interpolate with: 2 pixels of slope
    assert error.max() < 0.15
    assert error[1:-1, 1:-1].max() < 0.03


def test_one_window_on_its_own_grid_is_taken_as_it_is():
    values = np.random.default_rng(0).normal(size=(5, 6, 8)).astype(np.float32)
    found = blended(lambda top, left: values, (24, 32), (24, 32), (6, 8))
    assert np.allclose(found, values.transpose(1, 2, 0), atol=1e-6)


def test_what_lies_in_the_padding_is_never_seen():
    values = np.ones((1, 12, 16), np.float32)
    values[:, 9:], values[:, :, 13:] = 1e6, 1e6
    found = blended(lambda top, left: values, (36, 52), (48, 64), (9, 13))
    assert np.array_equal(found, np.ones((9, 13, 1)))
