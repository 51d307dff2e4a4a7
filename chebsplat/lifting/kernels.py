"""Loops over observations, in numba: Gaussian i has rows starts[i] to starts[i + 1], by views.

A Gaussian is worked off by one thread, in float64 and in this order: the same bits for any number
of threads.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import kernel, serial
from chebsplat.kernels.threads import in_parts


@kernel
def place(first, last, ids, weights, sums, view, cursors, views, to_weights, to_means):
    """Append one view's observations, each Gaussian at most once: at its cursor, which moves on."""
    for m in range(first, last):
        row = cursors[ids[m]]
        cursors[ids[m]] = row + 1
        views[row], to_weights[row] = view, weights[m]
        for c in range(sums.shape[1]):
            to_means[row, c] = sums[m, c] / weights[m]


@serial
def _direction(means, lengths, factors, first, last, mask, out):
    """out = Σ factor · b / |b| over the rows of the mask; returns Σ factor."""
    for c in range(len(out)):
        out[c] = 0.0
    total = 0.0
    for row in range(first, last):
        if mask[row - first]:
            total += factors[row - first]
            scale = factors[row - first] / lengths[row - first]
            for c in range(len(out)):
                out[c] += scale * means[row, c]
    return total


@serial
def _length(direction):
    square = 0.0
    for c in range(len(direction)):
        square += direction[c] * direction[c]
    return math.sqrt(square)


@serial
def _average(means, weights, lengths, first, last, mask, steps, floor, factors, direction, out):
    """Mean of the mask's rows, after `steps` to the median of their directions; returns r of the
    mean.

    Every step takes a row's weight over its chord to the direction of the last average, or over
    `floor` if less.
    """
    for row in range(first, last):
        factors[row - first] = weights[row]
    total = _direction(means, lengths, factors, first, last, mask, direction)
    for c in range(len(out)):
        out[c] = np.float32(0)
    if total == 0:
        return 0.0
    agreement = _length(direction) / total
    for _ in range(steps):
        size = max(_length(direction), 1e-12 * total)
        for row in range(first, last):
            cosine = 0.0
            for c in range(len(direction)):
                cosine += means[row, c] * direction[c]
            cosine /= lengths[row - first] * size
            factors[row - first] = weights[row] / max(math.sqrt(max(2 - 2 * cosine, 0.0)), floor)
        total = _direction(means, lengths, factors, first, last, mask, direction)
    for c in range(len(out)):
        direction[c] = 0.0
    total = 0.0
    for row in range(first, last):
        if mask[row - first]:
            total += factors[row - first]
            for c in range(len(out)):
                direction[c] += factors[row - first] * means[row, c]
    for c in range(len(out)):
        out[c] = direction[c] / total
    return agreement


@kernel
def _averages(
    begin, end, starts, views, weights, means, half_of, steps, floor, features, agreement
):  # fmt: skip
    channels, longest = means.shape[1], 0
    for i in range(begin, end):
        longest = max(longest, starts[i + 1] - starts[i])
    lengths, factors, direction = np.empty(longest), np.empty(longest), np.empty(channels)
    mask = np.empty(longest, np.bool_)
    for i in range(begin, end):
        first, last = starts[i], starts[i + 1]
        for row in range(first, last):
            square = 0.0
            for c in range(channels):
                square += np.float64(means[row, c]) * means[row, c]
            lengths[row - first] = max(math.sqrt(square), 1e-12)
        for half in range(3):
            for row in range(first, last):
                mask[row - first] = half == 0 or half_of[views[row]] == half - 1
            r = _average(means, weights, lengths, first, last, mask, steps, floor, factors,
                         direction, features[half, i])  # fmt: skip
            if half == 0:
                agreement[i] = r


def averages(starts, views, weights, means, half_of, steps, floor) -> tuple[np.ndarray, np.ndarray]:
    """Averages f32 [3, N, C] over all views and each half, `half_of` [V]; agreement r f32 [N]."""
    n = len(starts) - 1
    features, agreement = np.zeros((3, n, means.shape[1]), np.float32), np.zeros(n, np.float32)
    in_parts(_averages, n, starts, views, weights, means, half_of, steps, floor, features,
             agreement)  # fmt: skip
    return features, agreement
