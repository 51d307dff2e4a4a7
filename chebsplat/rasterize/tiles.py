"""Compositing and its adjoint, tile by tile, for one view and float32.

A tile of 16×16 pixels is 16 *cells* of 4×4: the 16 pixels of a cell are the lanes of every inner loop, so that each
is a vector instruction or two. A cell is visited only if the Gaussian's ellipse α ≥ 1/255 may reach it. Backward
recomputes α front to back, keeps it, and walks back with a suffix sum, so that no division by 1 − α accumulates.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.jit import inline, kernel, prange
from chebsplat.rasterize.binning import TILE
from chebsplat.rasterize.lanes import (
    HALF,
    LANES,
    LOG2_255,
    N_GEOMETRY,
    ONE,
    ZERO,
    accumulate,
    blend,
    by_channel,
    by_geometry,
    places,
    reach,
    sum_lanes,
)  # fmt: skip


@inline
def _place(means2d, whitening, i, left, top):
    """Gaussian i's whitening, and (u, v) at the tile's first pixel centre."""
    p, q, r = whitening[i, 0], whitening[i, 1], whitening[i, 2]
    dx, dy = np.float32(left) + HALF - means2d[i, 0], np.float32(top) + HALF - means2d[i, 1]
    return p, q, r, p * dx + q * dy, r * dy


@inline
def _order(j, n):
    """The j-th tile: neighbours go to different threads, for balance."""
    stride = (n + 15) // 16
    return j // stride + 16 * (j % stride)


@kernel
def forward(means2d, whitening, opacities, colors, tile_starts, gaussian, width, height, max_alpha):
    """Composite front to back. colors [N, D] -> render [H, W, D] and transmittance [H, W]."""
    columns, channels = (width + TILE - 1) // TILE, colors.shape[1]
    render = np.empty((height, width, channels), np.float32)
    transmittance = np.empty((height, width), np.float32)
    n_tiles = len(tile_starts) - 1
    for j in prange(16 * ((n_tiles + 15) // 16)):
        tile = _order(j, n_tiles)
        if tile >= n_tiles:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        before = np.zeros((LANES, LANES), np.float32)  # T; negated once a pixel is done; 0 outside the image
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                before[4 * (y >> 2) + (x >> 2), 4 * (y & 3) + (x & 3)] = ONE
        sums, weights = np.zeros((LANES, channels, LANES), np.float32), np.empty(LANES, np.float32)
        alphas, fronts = np.empty((LANES, LANES), np.float32), np.empty((LANES, LANES), np.float32)
        offsets, alive, hits = places(), np.ones(LANES, np.int32), np.empty(LANES, np.int32)
        cells, n_alive = np.empty(LANES, np.int32), LANES
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = gaussian[k]
            p, q, r, u, v = _place(means2d, whitening, i, left, top)
            log_opacity = np.float32(math.log2(opacities[i]))
            n = reach(u, v, p, q, r, log_opacity + LOG2_255, offsets, alive, hits, cells, 0)
            if n > 0:
                n_alive -= blend(
                    u, v, p, q, r, log_opacity, max_alpha, offsets, cells, 0, n, before, alphas, fronts, alive
                )
                accumulate(alphas, fronts, weights, cells, n, colors, i, sums)
            if n_alive == 0:
                break
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                cell, lane = 4 * (y >> 2) + (x >> 2), 4 * (y & 3) + (x & 3)
                transmittance[top + y, left + x] = abs(before[cell, lane])
                for d in range(channels):
                    render[top + y, left + x, d] = sums[cell, d, lane]
    return render, transmittance


@kernel
def backward(
    means2d, whitening, opacities, colors, tile_starts, gaussian, pair, width, height, max_alpha, grad, grad_alpha
):
    """Records [P, N_GEOMETRY + D], one a pair, and whether the image's gradient is finite.

    Args: grad [H, W, D] of the render, grad_alpha [H, W].
    """
    columns, channels = (width + TILE - 1) // TILE, colors.shape[1]
    records = np.empty((len(gaussian), N_GEOMETRY + channels), np.float32)
    n_tiles = len(tile_starts) - 1
    finite = np.ones(n_tiles, np.bool_)
    for j in prange(16 * ((n_tiles + 15) // 16)):
        tile = _order(j, n_tiles)
        if tile >= n_tiles:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        before, by_alpha = np.zeros((LANES, LANES), np.float32), np.zeros((LANES, LANES), np.float32)
        grads, check = np.zeros((LANES, channels, LANES), np.float32), ZERO
        tall_grads = np.zeros((LANES, LANES, (channels + 7) // 8 * 8), np.float32)
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                cell, lane = 4 * (y >> 2) + (x >> 2), 4 * (y & 3) + (x & 3)
                before[cell, lane], by_alpha[cell, lane] = ONE, grad_alpha[top + y, left + x]
                check += ZERO * by_alpha[cell, lane]
                for d in range(channels):
                    grads[cell, d, lane] = tall_grads[cell, lane, d] = grad[top + y, left + x, d]
                    check += ZERO * grads[cell, d, lane]
        finite[tile] = check == ZERO
        start, n_pairs = tile_starts[tile], tile_starts[tile + 1] - tile_starts[tile]
        offsets, alive, hits = places(), np.ones(LANES, np.int32), np.empty(LANES, np.int32)
        cells, firsts = np.empty(LANES * n_pairs + 1, np.int32), np.zeros(n_pairs + 1, np.int64)
        alphas, fronts = np.empty((LANES * n_pairs, LANES), np.float32), np.empty((LANES * n_pairs, LANES), np.float32)
        n_alive = LANES
        for k in range(n_pairs):
            i, n = gaussian[start + k], 0
            if n_alive > 0:
                p, q, r, u, v = _place(means2d, whitening, i, left, top)
                log_opacity = np.float32(math.log2(opacities[i]))
                n = reach(u, v, p, q, r, log_opacity + LOG2_255, offsets, alive, hits, cells, firsts[k])
                n_alive -= blend(
                    u, v, p, q, r, log_opacity, max_alpha, offsets, cells, firsts[k], n, before, alphas, fronts, alive
                )
            firsts[k + 1] = firsts[k] + n
        behind, slopes = np.zeros((LANES, LANES), np.float32), np.empty((LANES, LANES), np.float32)
        weights, by_colors = np.empty(LANES, np.float32), np.empty((channels, LANES), np.float32)
        color = np.zeros((channels + 7) // 8 * 8, np.float32)
        for k in range(n_pairs - 1, -1, -1):
            i, first, n = gaussian[start + k], firsts[k], firsts[k + 1] - firsts[k]
            record = records[pair[start + k]]
            if n == 0:
                record[:] = ZERO
                continue
            p, q, r, u, v = _place(means2d, whitening, i, left, top)
            for d in range(channels):
                color[d] = colors[i, d]
            by_channel(alphas, fronts, cells, first, n, color, grads, tall_grads, by_alpha, slopes, weights, by_colors)
            by_geometry(u, v, p, q, r, max_alpha, offsets, cells, first, n, alphas, fronts, slopes, behind, record)
            sum_lanes(by_colors, record)
    return records, finite.all()


@kernel
def reduce(records, pair_starts, whitening, opacities):
    """Sum each Gaussian's records, in the order of its pairs.

    Returns: gradients to means2d [N, 2]; moments [N, 3] for `ellipses.project_adjoint`; gradients to opacities [N],
      the absolute gradient to means2d [N, 2], and to colors [N, D].
    """
    n, channels = len(pair_starts) - 1, records.shape[1] - N_GEOMETRY
    to_means2d, moments = np.zeros((n, 2), np.float32), np.zeros((n, 3), np.float32)
    to_opacities, absolute = np.zeros(n, np.float32), np.zeros((n, 2), np.float32)
    to_colors = np.zeros((n, channels), np.float32)
    for i in prange(n):
        if pair_starts[i] == pair_starts[i + 1]:
            continue
        total = np.zeros(N_GEOMETRY)
        for k in range(pair_starts[i], pair_starts[i + 1]):
            for d in range(N_GEOMETRY):
                total[d] += records[k, d]
            for d in range(channels):
                to_colors[i, d] += records[k, N_GEOMETRY + d]
        p, q, r = 1.0 * whitening[i, 0], 1.0 * whitening[i, 1], 1.0 * whitening[i, 2]
        to_means2d[i, 0] = 2 * p * total[1]
        to_means2d[i, 1] = 2 * (q * total[1] + r * total[2])
        moments[i, 0], moments[i, 1], moments[i, 2] = total[3], total[4], total[5]
        to_opacities[i] = total[0] / (math.log(2.0) * opacities[i])
        absolute[i, 0], absolute[i, 1] = total[6], total[7]
    return to_means2d, moments, to_opacities, absolute, to_colors
