"""Losses with their gradients in one sweep over an image, in numba: L1 and SSIM; feature distance.

Images are [H, W, 3] seen as rows of W · 3 values, so a tap of the horizontal window is a shift by
3. A part of the rows computes its neighbours' ends once more instead of waiting for them: no thread
writes what another writes, and their number changes no bit.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import body, kernel
from chebsplat.kernels.threads import in_parts

WINDOW, SIGMA = 11, 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
HALF = WINDOW // 2
_x = np.arange(WINDOW) - HALF
TAPS = (np.exp(-0.5 * (_x / SIGMA) ** 2) / np.exp(-0.5 * (_x / SIGMA) ** 2).sum()).astype(
    np.float32
)
TINY = np.float32(1e-12)


@body
def _blur_products(a, b, y, row, out):
    """Horizontal blur of row y of a, b, a², b², ab into out [5, L], zero beyond the border."""
    length = a.shape[1]
    for x in range(length):
        u, v = a[y, x], b[y, x]
        row[0, x + 3 * HALF], row[1, x + 3 * HALF] = u, v
        row[2, x + 3 * HALF], row[3, x + 3 * HALF], row[4, x + 3 * HALF] = u * u, v * v, u * v
    _blur(row, out)


@body
def _blur(row, out):
    """Horizontal blur of rows [K, L + 6 HALF] into out [K, L]."""
    out[:] = np.float32(0)
    for k in range(len(out)):
        for t in range(WINDOW):
            tap = TAPS[t]
            for x in range(out.shape[1]):
                out[k, x] += tap * row[k, x + 3 * t]


@body
def _gather(ring, y, height, out):
    """Vertical blur at row y of the rows about it, which `ring` [WINDOW, K, L] holds."""
    out[:] = np.float32(0)
    for t in range(max(0, HALF - y), min(WINDOW, height + HALF - y)):
        tap, near = TAPS[t], ring[(y + t - HALF) % WINDOW]
        for k in range(len(out)):
            for x in range(out.shape[1]):
                out[k, x] += tap * near[k, x]


@body
def _sum(terms):
    """In order, apart from the loop that makes them: that one vectorises then."""
    total = 0.0
    for x in range(len(terms)):
        total += terms[x]
    return total


@body
def _compare(m, weight, terms, row):
    """SSIM by value under a weight [L], and its slopes to mean, variance and covariance into row,
    from blurred a, b, a², b², ab [5, L].
    """
    for x in range(len(weight)):
        mean_a, mean_b = m[0, x], m[1, x]
        squares = mean_a * mean_a + mean_b * mean_b
        top_1 = np.float32(2) * mean_a * mean_b + C1
        top_2 = np.float32(2) * (m[4, x] - mean_a * mean_b) + C2
        low_1, low_2 = squares + C1, m[2, x] + m[3, x] - squares + C2
        over = np.float32(1) / (low_1 * low_2)
        value, w = top_1 * top_2 * over, weight[x]
        terms[x] = w * value
        by_cov = np.float32(2) * top_1 * over * w
        by_var = -value / low_2 * w
        by_mean = (
            np.float32(2) * mean_b * top_2 * over - np.float32(2) * mean_a * value / low_1
        ) * w
        row[0, x + 3 * HALF] = by_mean - np.float32(2) * mean_a * by_var - mean_b * by_cov
        row[1, x + 3 * HALF], row[2, x + 3 * HALF] = by_var, by_cov


@body
def _to_gradient(m, a, b, weight, weight_ssim, terms, gradient):
    """Gradient [L] of (1 − w) L1 + w (1 − SSIM) to a, from blurred slopes [3, L]; weighted L1."""
    for x in range(len(a)):
        difference, w = a[x] - b[x], weight[x]
        terms[x] = w * abs(difference)
        sign = np.float32(difference > 0) - np.float32(difference < 0)
        by_ssim = m[0, x] + np.float32(2) * a[x] * m[1, x] + b[x] * m[2, x]
        gradient[x] = (np.float32(1) - weight_ssim) * sign * w - weight_ssim * by_ssim


@kernel
def _photometric(first, last, a, b, weight, weight_ssim, gradient, values, distance):
    """Gradient, SSIM and L1 of rows first...last − 1.

    A row waits for the rows about it, twice: it is blurred, compared HALF rows later, and its
    gradient follows after as many again. Rings hold the rows that are still to be asked for, and
    those beyond the part's ends are computed by its neighbour, too.
    """
    height, length = a.shape
    blurred = np.empty((WINDOW, 5, length), np.float32)
    slopes = np.empty((WINDOW, 3, length), np.float32)
    row, m = np.zeros((5, length + 6 * HALF), np.float32), np.empty((5, length), np.float32)
    terms = np.empty(length, np.float32)
    for ahead in range(max(first - 2 * HALF, 0), last + 2 * HALF):
        if ahead < height:
            _blur_products(a, b, ahead, row, blurred[ahead % WINDOW])
        y = ahead - HALF
        if max(first - HALF, 0) <= y < min(last + HALF, height):
            _gather(blurred, y, height, m)
            _compare(m, weight[y], terms, row)
            _blur(row[:3], slopes[y % WINDOW])
            if first <= y < last:
                values[y] = _sum(terms)
        y = ahead - 2 * HALF
        if first <= y < last:
            _gather(slopes, y, height, m[:3])
            _to_gradient(m, a[y], b[y], weight[y], weight_ssim, terms, gradient[y])
            distance[y] = _sum(terms)


def photometric(
    a: np.ndarray, b: np.ndarray, weight: np.ndarray, weight_ssim: float
) -> tuple[float, np.ndarray]:
    """Loss (1 − w) L1 + w (Σ weight − SSIM) and its gradient [H, W, 3] to `a`.

    Args: a, b [H, W, 3] float32 in [0, 1]; weight [H, W, 3] what each value counts, summing to 1
      (or 0).
    """
    shape = a.shape
    a, b, weight = (np.ascontiguousarray(v.reshape(shape[0], -1)) for v in (a, b, weight))
    gradient, (values, distance) = np.empty_like(a), np.empty((2, len(a)))
    in_parts(_photometric, len(a), a, b, weight, np.float32(weight_ssim), gradient, values,
             distance)  # fmt: skip
    loss = (1 - weight_ssim) * distance.sum() + weight_ssim * (
        weight.sum(dtype=np.float64) - values.sum()
    )
    return float(loss), gradient.reshape(shape)


@body
def _span(i, n, size):
    """Pixels [start, stop) of cell i of n by adaptive pooling: neighbours may share one."""
    return i * size // n, ((i + 1) * size + n - 1) // n


@kernel
def _compare_cells(first, last, render, target, share, by_channel, slopes, values):
    """Slopes and values of rows of cells; see `feature_distance`."""
    height, width, channels = render.shape
    rows, columns = share.shape
    for i in range(first, last):
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
                total / np.float32(channels)
                if by_channel
                else np.float32(math.sqrt(total / np.float32(channels)))
            )
            scale = share[i, j] / (area * np.float32(channels))
            for c in range(channels):
                slope = np.float32(mean[c] > 0) - np.float32(mean[c] < 0)
                if not by_channel:
                    slope = mean[c] / max(distance, TINY)
                slopes[i, j, c] = scale * slope if share[i, j] != 0 else np.float32(0)
            if share[i, j] != 0:  # what does not count may be anything
                values[i] += share[i, j] * distance


@kernel
def _spread(first, last, slopes, gradient):
    """A cell's slopes, in rows of pixels, over those that it pools."""
    height, width, channels = gradient.shape
    rows, columns, _ = slopes.shape
    for y in range(first, last):
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


def feature_distance(render, target, share, by_channel) -> tuple[np.ndarray, np.ndarray]:
    """Σ share · distance of pooled to target, by row of cells, and its gradient to `render`.

    The distance is mean_c |pooled − target| by channel, else √(mean_c (pooled − target)²).

    Args: render [H, W, C], target [h, w, C], share [h, w] what each cell counts, float32;
      by_channel bool.
    Returns: values [h] float64; gradient [H, W, C].
    """
    slopes, values = np.empty((*share.shape, render.shape[2]), np.float32), np.zeros(len(share))
    gradient = np.empty(render.shape, np.float32)
    in_parts(_compare_cells, len(share), render, target, share, by_channel, slopes, values)
    in_parts(_spread, len(render), slopes, gradient)
    return values, gradient
