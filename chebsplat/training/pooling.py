"""The feature loss and its gradient in one sweep, in numba: features averaged down to the teacher's resolution."""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import inline, kernel, prange

TINY = np.float32(1e-12)


@inline
def _span(i, n, size):
    """Pixels [start, stop) of cell i of n, as adaptive pooling cuts them: neighbours may share one."""
    return i * size // n, ((i + 1) * size + n - 1) // n


@kernel
def feature_distance(render, target, share, by_channel):
    """Σ share · distance of pooled to target, by row of cells, and its gradient to `render`.

    The distance is mean_c |pooled − target| by channel, else √(mean_c (pooled − target)²).

    Args: render [H, W, C], target [h, w, C], share [h, w] what each cell counts, float32; by_channel bool.
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
            for c in range(channels):
                mean[c] = np.float32(0)
            for y in range(top, bottom):
                for x in range(left, right):
                    for c in range(channels):
                        mean[c] += render[y, x, c]
            area = np.float32((bottom - top) * (right - left))
            total = np.float32(0)
            for c in range(channels):
                mean[c] = mean[c] / area - target[i, j, c]
                total += abs(mean[c]) if by_channel else mean[c] * mean[c]
            distance = (
                total / np.float32(channels) if by_channel else np.float32(math.sqrt(total / np.float32(channels)))
            )
            scale = share[i, j] / (area * np.float32(channels))
            for c in range(channels):
                slope = np.float32(mean[c] > 0) - np.float32(mean[c] < 0)
                if not by_channel:
                    slope = mean[c] / max(distance, TINY)
                slopes[i, j, c] = scale * slope if share[i, j] != 0 else np.float32(0)
            if share[i, j] != 0:  # what does not count may be anything
                values[i] += share[i, j] * distance
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
