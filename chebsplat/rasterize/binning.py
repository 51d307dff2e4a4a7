"""Which Gaussians touch which tiles, front to back.

A Gaussian touches a tile through one *pair*. Pairs are numbered Gaussian by Gaussian, so that the gradient records a
Gaussian collects lie together and are summed in a fixed order: no atomics, the same bits for any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.jit import serial

TILE = 16
ALPHA_MIN = 1 / 255
DIGIT = 11  # bits of a sorting pass: three passes for 32


@serial
def _by_depth(depths, shown):
    """Indices of the shown Gaussians by ascending depth, ties by index: a radix sort of positive float32."""
    index = np.flatnonzero(shown).astype(np.int32)
    n = len(index)
    keys = depths[index].view(np.uint32)
    other_index, other_keys = np.empty(n, np.int32), np.empty(n, np.uint32)
    for k in range(3):
        shift, starts = np.uint32(k * DIGIT), np.zeros((1 << DIGIT) + 1, np.int64)
        mask = np.uint32((1 << DIGIT) - 1)
        for m in range(n):
            starts[((keys[m] >> shift) & mask) + 1] += 1
        starts = np.cumsum(starts)
        for m in range(n):
            digit = (keys[m] >> shift) & mask
            where = starts[digit]
            other_index[where], other_keys[where] = index[m], keys[m]
            starts[digit] = where + 1
        index, other_index = other_index, index
        keys, other_keys = other_keys, keys
    return index


@serial
def bin_gaussians(means2d, covariances, depths, radii, opacities, colors, width, height):
    """Pairs of Gaussians and tiles.

    Args: of one view, as `ellipses.project` gives them; opacities [N]; colors [N, D].
    Returns: tile_starts i64 [tiles + 1] and, in tile order and front to back within, gaussian i32 [P] and pair
      i32 [P]; pair_starts i64 [N + 1] by Gaussian.
    Choices: the box of the ellipse α ≥ 1/255; a Gaussian that is fainter, or not finite in opacity or in any
      channel, touches nothing.
    """
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    n = len(means2d)
    shown, boxes = np.zeros(n, np.bool_), np.zeros((n, 4), np.int32)
    counts, tile_starts = np.zeros(n + 1, np.int64), np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        opacity, finite = opacities[i], np.float32(0)
        if radii[i] == 0 or not (opacity >= np.float32(ALPHA_MIN) and math.isfinite(opacity)):
            continue
        for d in range(colors.shape[1]):
            finite += colors[i, d] * np.float32(0)
        if finite != 0:
            continue
        limit = 2.0 * math.log(255.0 * opacity) + 1e-3  # the tiles' own test is exact
        reach_x, reach_y = math.sqrt(limit * covariances[i, 0]), math.sqrt(limit * covariances[i, 2])
        # a pixel's centre is at +0.5
        x0, x1 = max(means2d[i, 0] - reach_x - 0.5, 0.0), min(means2d[i, 0] + reach_x + 0.5, float(width))
        y0, y1 = max(means2d[i, 1] - reach_y - 0.5, 0.0), min(means2d[i, 1] + reach_y + 0.5, float(height))
        if not (x0 < x1 and y0 < y1):
            continue
        shown[i] = True
        boxes[i, 0], boxes[i, 1] = int(x0) // TILE, (math.ceil(x1) + TILE - 1) // TILE
        boxes[i, 2], boxes[i, 3] = int(y0) // TILE, (math.ceil(y1) + TILE - 1) // TILE
        counts[i + 1] = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        for ty in range(boxes[i, 2], boxes[i, 3]):
            for tx in range(boxes[i, 0], boxes[i, 1]):
                tile_starts[ty * columns + tx + 1] += 1
    pair_starts, tile_starts = np.cumsum(counts), np.cumsum(tile_starts)
    total = tile_starts[-1]
    gaussian, pair = np.empty(total, np.int32), np.empty(total, np.int32)
    cursor = tile_starts[:-1].copy()
    for i in _by_depth(depths, shown):
        k = pair_starts[i]
        for ty in range(boxes[i, 2], boxes[i, 3]):
            for tx in range(boxes[i, 0], boxes[i, 1]):
                where = cursor[ty * columns + tx]
                gaussian[where], pair[where] = i, k
                cursor[ty * columns + tx] = where + 1
                k += 1
    return tile_starts, gaussian, pair, pair_starts
