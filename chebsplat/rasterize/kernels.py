"""Tile kernels of the CPU rasterizer, for one view and float32.

A Gaussian touches a tile through one *pair*. Pairs are numbered Gaussian by Gaussian, so that the gradient records a
Gaussian collects lie together and are summed in a fixed order: no atomics, the same bits for any number of threads.
Within a row of a tile only the pixels inside the ellipse α ≥ 1/255 are visited, from its analytic span.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.jit import inline, kernel, prange, serial

TILE = 16
T_MIN = np.float32(1e-4)
ALPHA_MIN = np.float32(1 / 255)
N_GEOMETRY = 8  # of a gradient record: mean x, y; conic a, b, c; opacity; |mean x|, |mean y|


@serial
def bin_gaussians(means2d, conics, opacities, order, width, height):
    """Pairs of Gaussians and tiles.

    Args: means2d [N, 2], conics [N, 3], opacities [N]; order [M] i64, visible Gaussians front to back.
    Returns: tile_starts i64 [tiles + 1] and, in tile order and front to back within, gaussian i32 [P] and pair
      i32 [P]; pair_starts i64 [N + 1] by Gaussian.
    """
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    n = len(means2d)
    boxes = np.zeros((len(order), 4), np.int32)
    counts = np.zeros(n + 1, np.int64)
    tile_starts = np.zeros(columns * rows + 1, np.int64)
    for m in range(len(order)):
        i = order[m]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        determinant = np.float64(a) * c - np.float64(b) * b
        limit = 2.0 * math.log(255.0 * opacities[i])
        if not (determinant > 0 and limit >= 0):
            continue
        reach_x = min(math.sqrt(limit * c / determinant), 1e6)
        reach_y = min(math.sqrt(limit * a / determinant), 1e6)
        # a pixel's centre is at +0.5; a little slack, the span test is exact
        x0 = max(math.floor(means2d[i, 0] - reach_x - 0.5), 0.0)
        x1 = min(math.ceil(means2d[i, 0] + reach_x), float(width))
        y0 = max(math.floor(means2d[i, 1] - reach_y - 0.5), 0.0)
        y1 = min(math.ceil(means2d[i, 1] + reach_y), float(height))
        if not (x0 < x1 and y0 < y1):
            continue
        boxes[m, 0], boxes[m, 1] = int(x0) // TILE, (int(x1) + TILE - 1) // TILE
        boxes[m, 2], boxes[m, 3] = int(y0) // TILE, (int(y1) + TILE - 1) // TILE
        counts[i + 1] = (boxes[m, 1] - boxes[m, 0]) * (boxes[m, 3] - boxes[m, 2])
        for ty in range(boxes[m, 2], boxes[m, 3]):
            for tx in range(boxes[m, 0], boxes[m, 1]):
                tile_starts[ty * columns + tx + 1] += 1
    pair_starts = np.cumsum(counts)
    tile_starts = np.cumsum(tile_starts)
    total = tile_starts[-1]
    gaussian, pair = np.empty(total, np.int32), np.empty(total, np.int32)
    cursor = tile_starts[:-1].copy()
    for m in range(len(order)):
        i = order[m]
        k = pair_starts[i]
        for ty in range(boxes[m, 2], boxes[m, 3]):
            for tx in range(boxes[m, 0], boxes[m, 1]):
                where = cursor[ty * columns + tx]
                gaussian[where], pair[where] = i, k
                cursor[ty * columns + tx] += 1
                k += 1
    return tile_starts, gaussian, pair, pair_starts


@inline
def _span(a, b, c, dy, limit, mean_x, left, right):
    """Columns [first, last) of a tile row whose centres lie in the ellipse a dx² + 2 b dx dy + c dy² ≤ limit."""
    inside = b * dy * b * dy - a * (c * dy * dy - limit)
    if not inside > 0:
        return left, left
    root = math.sqrt(inside)
    low = mean_x + (-b * dy - root) / a - np.float32(0.5)
    high = mean_x + (-b * dy + root) / a - np.float32(0.5)
    first = left if low < left else min(int(low), right)
    last = right if high >= right else max(int(high) + 2, left)
    return first, min(last, right)


@kernel
def forward(means2d, conics, opacities, colors, tile_starts, gaussian, width, height, max_alpha):
    """Composite front to back. colors [N, D] -> render [H, W, D] and transmittance [H, W]."""
    columns = (width + TILE - 1) // TILE
    channels = colors.shape[1]
    render = np.zeros((height, width, channels), np.float32)
    transmittance = np.ones((height, width), np.float32)
    for tile in prange(len(tile_starts) - 1):
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        bottom, right = min(top + TILE, height), min(left + TILE, width)
        done = np.zeros((TILE, TILE), np.bool_)
        alive = (bottom - top) * (right - left)
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = gaussian[k]
            mean_x, mean_y, opacity = means2d[i, 0], means2d[i, 1], opacities[i]
            a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
            limit = np.float32(2.0) * np.float32(math.log(np.float32(255.0) * opacity)) + np.float32(1e-3)
            for y in range(top, bottom):
                dy = np.float32(y) + np.float32(0.5) - mean_y
                first, last = _span(a, b, c, dy, limit, mean_x, left, right)
                for x in range(first, last):
                    if done[y - top, x - left]:
                        continue
                    dx = np.float32(x) + np.float32(0.5) - mean_x
                    sigma = np.float32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                    alpha = min(opacity * math.exp(-sigma), max_alpha)
                    if not alpha >= ALPHA_MIN:
                        continue
                    before = transmittance[y, x]
                    after = before * (np.float32(1.0) - alpha)
                    if after <= T_MIN:
                        done[y - top, x - left] = True
                        alive -= 1
                        continue
                    weight = alpha * before
                    for d in range(channels):
                        render[y, x, d] += weight * colors[i, d]
                    transmittance[y, x] = after
            if alive == 0:
                break
    return render, transmittance


@kernel
def backward(
    means2d, conics, opacities, colors, tile_starts, gaussian, pair, width, height, max_alpha, grad, total, grad_alpha
):
    """Gradient records [P, N_GEOMETRY + D], one a pair.

    Args: grad [H, W, D] of the render, total [H, W] = grad · render + grad_alpha · alpha (background included),
      grad_alpha [H, W].
    What lies behind a Gaussian is `total` less the running sum in front: no division by 1 − α ever accumulates.
    """
    columns = (width + TILE - 1) // TILE
    channels = colors.shape[1]
    records = np.zeros((len(gaussian), N_GEOMETRY + channels), np.float32)
    for tile in prange(len(tile_starts) - 1):
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        bottom, right = min(top + TILE, height), min(left + TILE, width)
        transmittance = np.ones((TILE, TILE), np.float32)
        front = np.zeros((TILE, TILE), np.float32)
        done = np.zeros((TILE, TILE), np.bool_)
        alive = (bottom - top) * (right - left)
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = gaussian[k]
            record = records[pair[k]]
            mean_x, mean_y, opacity = means2d[i, 0], means2d[i, 1], opacities[i]
            a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
            limit = np.float32(2.0) * np.float32(math.log(np.float32(255.0) * opacity)) + np.float32(1e-3)
            for y in range(top, bottom):
                dy = np.float32(y) + np.float32(0.5) - mean_y
                first, last = _span(a, b, c, dy, limit, mean_x, left, right)
                for x in range(first, last):
                    if done[y - top, x - left]:
                        continue
                    dx = np.float32(x) + np.float32(0.5) - mean_x
                    sigma = np.float32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                    falloff = math.exp(-sigma)
                    alpha = min(opacity * falloff, max_alpha)
                    if not alpha >= ALPHA_MIN:
                        continue
                    before = transmittance[y - top, x - left]
                    after = before * (np.float32(1.0) - alpha)
                    if after <= T_MIN:
                        done[y - top, x - left] = True
                        alive -= 1
                        continue
                    weight = alpha * before
                    q = grad_alpha[y, x]
                    for d in range(channels):
                        q += grad[y, x, d] * colors[i, d]
                    for d in range(channels):
                        record[N_GEOMETRY + d] += weight * grad[y, x, d]
                    front[y - top, x - left] += weight * q
                    transmittance[y - top, x - left] = after
                    if opacity * falloff > max_alpha:
                        continue
                    behind = total[y, x] - front[y - top, x - left]
                    v_alpha = before * q - behind / (np.float32(1.0) - alpha)
                    v_sigma = -alpha * v_alpha
                    v_x = -v_sigma * (a * dx + b * dy)
                    v_y = -v_sigma * (b * dx + c * dy)
                    record[0] += v_x
                    record[1] += v_y
                    record[2] += np.float32(0.5) * dx * dx * v_sigma
                    record[3] += dx * dy * v_sigma
                    record[4] += np.float32(0.5) * dy * dy * v_sigma
                    record[5] += falloff * v_alpha
                    record[6] += abs(v_x)
                    record[7] += abs(v_y)
            if alive == 0:
                break
    return records


@kernel
def reduce_records(records, pair_starts):
    """Sum each Gaussian's records, [P, K] -> [N, K], in the order of its pairs."""
    n = len(pair_starts) - 1
    sums = np.zeros((n, records.shape[1]), np.float32)
    for i in prange(n):
        for k in range(pair_starts[i], pair_starts[i + 1]):
            for d in range(records.shape[1]):
                sums[i, d] += records[k, d]
    return sums
