"""One map of a whole image from overlapping maps of its windows, smoothly blended, on any grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

OVERLAP = 1 / 3  # of a window, at least: the stride of 2/3 that segmenters are evaluated with


def window_starts(length: int, window: int) -> list[int]:
    """First pixels of windows that cover [0, length) evenly; 0 alone where one is long enough."""
    if length <= window:
        return [0]
    count = math.ceil((length - window) / (window * (1 - OVERLAP))) + 1
    return [round(start) for start in np.linspace(0, length - window, count).tolist()]


def sampling(
    length: int, n_out: int, starts: list[int], k: int, window: int, n_cells: int
) -> np.ndarray:
    """Weights [n_out, n_cells] of the cells of window k in the entries of the grid, along one axis.

    Args: length: of the axis in pixels, which `n_out` grid entries share; starts: of all windows;
      n_cells: that window k is cut into.
    Choices: a triangle of the wider of entry and cell, which is linear interpolation onto a finer
      grid and an average onto a coarser one; times the window's weight, sin² from 0 to 1 over what
      it shares with a neighbour, so that the weights of two windows add up to 1; cells whose centre
      lies beyond the image (padding) weigh nothing.
    """
    at = starts[k] + (np.arange(n_cells) + 0.5) * (window / n_cells)
    entries = (np.arange(n_out) + 0.5) * (length / n_out)
    reach = max(length / n_out, window / n_cells)
    weights = np.clip(1 - np.abs(entries[:, None] - at) / reach, 0, None)
    ramp = np.ones(n_cells)
    if k > 0:
        shared = starts[k - 1] + window - starts[k]
        ramp *= np.sin(np.pi / 2 * np.clip((at - starts[k]) / shared, 0, 1)) ** 2
    if k + 1 < len(starts):
        shared = starts[k] + window - starts[k + 1]
        ramp *= np.sin(np.pi / 2 * np.clip((starts[k] + window - at) / shared, 0, 1)) ** 2
    return (weights * ramp * (at < length)).astype(np.float32)


def blended(
    window_map: Callable[[int, int], np.ndarray],
    size: tuple[int, int],
    window: tuple[int, int],
    grid: tuple[int, int],
) -> np.ndarray:
    """The map [h, w, C] of an image of `size` (H, W) on `grid` (h, w): weighted mean of the
    windows'.

    Args: window_map: (top, left) -> [C, hc, wc], the map of the window whose first pixel that is;
      what of it lies beyond the image is padding.
    """
    starts = [window_starts(n, side) for n, side in zip(size, window, strict=True)]
    total, weight = np.zeros(0), np.zeros((*grid, 1), np.float32)
    for row, top in enumerate(starts[0]):
        for column, left in enumerate(starts[1]):
            cells = np.asarray(window_map(top, left), np.float32)
            down = sampling(size[0], grid[0], starts[0], row, window[0], cells.shape[1])
            across = sampling(size[1], grid[1], starts[1], column, window[1], cells.shape[2])
            # [h, C, wc]; two large products, not one a channel
            rows = np.tensordot(down, cells, ([1], [1]))
            part = np.tensordot(rows, across, ([2], [1])).transpose(0, 2, 1)
            total = part if not total.size else total + part
            weight += np.outer(down.sum(1), across.sum(1))[..., None]
    return total / weight
