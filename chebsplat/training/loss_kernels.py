"""Losses with their gradients in one sweep over an image, in numba: L1 and SSIM; feature distance.

Images are [H, W, 3] seen as rows of W · 3 values, so a tap of the horizontal window is a shift by
3. Rows are independent in each of four passes; no pass writes what another thread writes, so the
thread count changes no bit.
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


@kernel
def _blur_products(first, last, a, b, out):
    """Horizontal blur of a, b, a², b², ab: [H, L] twice -> [H, 5, L], zero beyond the border."""
    length = a.shape[1]
    for y in range(first, last):
        row = np.zeros((5, length + 6 * HALF), np.float32)
        for x in range(length):
            u, v = a[y, x], b[y, x]
            row[0, x + 3 * HALF], row[1, x + 3 * HALF] = u, v
            row[2, x + 3 * HALF], row[3, x + 3 * HALF], row[4, x + 3 * HALF] = u * u, v * v, u * v
        for k in range(5):
            for t in range(WINDOW):
                tap = TAPS[t]
                for x in range(length):
                    out[y, k, x] += tap * row[k, x + 3 * t]


@body
def _sum(terms):
    """In order, apart from the loop that makes them: that one vectorises then."""
    total = 0.0
    for x in range(len(terms)):
        total += terms[x]
    return total


@kernel
def _compare(first, last, blurred, weight, values, slopes):
    """SSIM by row, under a weight [H, L]; derivatives [H, 3, L] to mean, variance, covariance."""
    height, _, length = blurred.shape
    for y in range(first, last):
        m, terms = np.zeros((5, length), np.float32), np.empty(length, np.float32)
        for t in range(max(0, HALF - y), min(WINDOW, height + HALF - y)):
            tap = TAPS[t]
            for k in range(5):
                for x in range(length):
                    m[k, x] += tap * blurred[y + t - HALF, k, x]
        for x in range(length):
            mean_a, mean_b = m[0, x], m[1, x]
            squares = mean_a * mean_a + mean_b * mean_b
            top_1 = np.float32(2) * mean_a * mean_b + C1
            top_2 = np.float32(2) * (m[4, x] - mean_a * mean_b) + C2
            low_1, low_2 = squares + C1, m[2, x] + m[3, x] - squares + C2
            over = np.float32(1) / (low_1 * low_2)
            value, w = top_1 * top_2 * over, weight[y, x]
            terms[x] = w * value
            by_cov = np.float32(2) * top_1 * over * w
            by_var = -value / low_2 * w
            by_mean = (
                np.float32(2) * mean_b * top_2 * over - np.float32(2) * mean_a * value / low_1
            ) * w
            slopes[y, 0, x] = by_mean - np.float32(2) * mean_a * by_var - mean_b * by_cov
            slopes[y, 1, x], slopes[y, 2, x] = by_var, by_cov
        values[y] = _sum(terms)


@kernel
def _blur_rows(first, last, slopes, out):
    """Horizontal blur of [H, 3, L], zero beyond the border."""
    _, n, length = slopes.shape
    for y in range(first, last):
        row = np.zeros(length + 6 * HALF, np.float32)
        for k in range(n):
            for x in range(length):
                row[x + 3 * HALF] = slopes[y, k, x]
            for t in range(WINDOW):
                tap = TAPS[t]
                for x in range(length):
                    out[y, k, x] += tap * row[x + 3 * t]


@kernel
def _gather(first, last, slopes, a, b, weight, weight_ssim, gradient, distance):
    """Gradient [H, L] of (1 − w) L1 + w (1 − SSIM) to a, and the weighted L1 by row."""
    height, _, length = slopes.shape
    for y in range(first, last):
        m, terms = np.zeros((3, length), np.float32), np.empty(length, np.float32)
        for t in range(max(0, HALF - y), min(WINDOW, height + HALF - y)):
            tap = TAPS[t]
            for k in range(3):
                for x in range(length):
                    m[k, x] += tap * slopes[y + t - HALF, k, x]
        for x in range(length):
            difference, w = a[y, x] - b[y, x], weight[y, x]
            terms[x] = w * abs(difference)
            sign = np.float32(difference > 0) - np.float32(difference < 0)
            by_ssim = m[0, x] + np.float32(2) * a[y, x] * m[1, x] + b[y, x] * m[2, x]
            gradient[y, x] = (np.float32(1) - weight_ssim) * sign * w - weight_ssim * by_ssim
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
    height, length = a.shape
    values, distance = np.empty((2, height))
    blurred, gradient = np.zeros((height, 5, length), np.float32), np.empty_like(a)
    slopes, blurred_slopes = np.empty((2, height, 3, length), np.float32)
    blurred_slopes[:] = 0
    in_parts(_blur_products, height, a, b, blurred)
    in_parts(_compare, height, blurred, weight, values, slopes)
    in_parts(_blur_rows, height, slopes, blurred_slopes)
    in_parts(_gather, height, blurred_slopes, a, b, weight, np.float32(weight_ssim), gradient,
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
