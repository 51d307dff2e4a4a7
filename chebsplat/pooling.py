"""The feature loss and its gradient in one sweep, in numba: features averaged down to the teacher's resolution, L1."""

from __future__ import annotations

import numpy as np

from chebsplat.jit import inline, kernel, prange


@inline
def _span(i, n, size):
    """Pixels [start, stop) of cell i of n, as adaptive pooling cuts them: neighbours may share one."""
    return i * size // n, ((i + 1) * size + n - 1) // n


@kernel
def feature_l1(render, target, share):
    """Σ share · mean_c |pooled − target|, by row of cells, and its gradient to `render`.

    Args: render [H, W, C], target [h, w, C], share [h, w] what each cell counts, float32.
    Returns: values [h] float64; gradient [H, W, C].
    """
    height, width, channels = render.shape
    rows, columns = share.shape
    slopes, values = np.empty((rows, columns, channels), np.float32), np.zeros(rows)
    for i in prange(rows):
        top, bottom = _span(i, rows, height)
        mean = np.empty(channels, np.float32)
        for j in range(columns):
            left, right = _span(j, columns, width)
            mean[:] = np.float32(0)
            for y in range(top, bottom):
                for x in range(left, right):
                    for c in range(channels):
                        mean[c] += render[y, x, c]
            area = np.float32((bottom - top) * (right - left))
            scale, total = share[i, j] / (area * np.float32(channels)), np.float32(0)
            for c in range(channels):
                difference = mean[c] / area - target[i, j, c]
                total += abs(difference)
                sign = np.float32(difference > 0) - np.float32(difference < 0)
                slopes[i, j, c] = scale * sign if share[i, j] != 0 else np.float32(0)
            if share[i, j] != 0:  # what does not count may be anything
                values[i] += share[i, j] * total / np.float32(channels)
    gradient = np.empty((height, width, channels), np.float32)
    for y in prange(height):
        for x in range(width):
            for c in range(channels):
                gradient[y, x, c] = np.float32(0)
        for i in range(y * rows // height, min(y * rows // height + 2, rows)):
            top, bottom = _span(i, rows, height)
            if top <= y < bottom:
                for j in range(columns):
                    left, right = _span(j, columns, width)
                    for x in range(left, right):
                        for c in range(channels):
                            gradient[y, x, c] += slopes[i, j, c]
    return values, gradient
