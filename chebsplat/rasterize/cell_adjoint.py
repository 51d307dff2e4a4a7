"""Adjoint of compositing inside a cell (see `cells`): records of Gaussians from pixels' gradients.

With g = dL/d(log₂ α), a record holds Σg, Σgu, Σgv, Σgu², Σguv, Σgv², Σ|g_x|, Σ|g_y| over the pixels
of a tile, then the gradients to the channels, in fours, and to the cell channels, in whole vectors.
"""

from __future__ import annotations

import numpy as np

from chebsplat.kernels.jit import lanes
from chebsplat.kernels.simd import fma, load, magnitude, splat, store, total, where
from chebsplat.rasterize.blocks import multiply
from chebsplat.rasterize.cells import (
    BLOCK,
    CELL_X,
    CELL_Y,
    IN_ORDER,
    LANE_X,
    LANE_Y,
    LANES,
    LN2,
    MOMENTS,
    N_GEOMETRY,
    SHAPE,
    TWO,
    ZERO,
    padded,
)


@lanes
def slopes(shapes, rows, grads, count, cell, depth, out):
    """out[m] = dL/d(weight m) by lane: gradients [cells, depth, 16] times channels of rows[m]."""
    at, step = LANES * cell * grads.shape[1], shapes.shape[1]
    for m in range(0, count, BLOCK):
        multiply(out, LANES * m, IN_ORDER, 0, LANES, shapes, SHAPE, step, 1, rows, m, 1,
                 grads, at, LANES, depth, 8, LANES, 0)  # fmt: skip


@lanes
def unwind(alphas, weights, out, count, max_alpha):
    """Turn dL/d(weight) into g = dL/d(log₂ α), in place, back to front.

    With B the slope of all that lies behind, as seen through it alone, dL/dα = T (slope − B) and B
    moves to B + α (slope − B) in front: no division by 1 − α.
    """
    behind, ceiling, ln2 = splat(ZERO), splat(max_alpha), splat(LN2)
    for m in range(count - 1, -1, -1):
        alpha = load(alphas, LANES * m)
        excess = load(out, LANES * m) - behind
        behind = fma(alpha, excess, behind)
        g = ln2 * load(weights, LANES * m) * excess
        store(out, LANES * m, where(alpha < ceiling, g, splat(ZERO)))


@lanes
def record_colors(weights, tall_grads, channels, count, cell, slots, records):
    """records[slots[m], N_GEOMETRY:] += Σ_lanes weights[m] tall_grads: by cell, 16 rows of D
    `channels` and a margin.

    The records have a multiple of four columns for them; what the last ones take up beyond D is
    never read.
    """
    row, at, step = channels, cell * (LANES * channels + LANES), records.shape[1]
    channels = padded(channels)
    for m in range(0, count, BLOCK):
        c = 0
        while c + 16 <= channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1,
                     slots, 0, 0, tall_grads, at + c, row, LANES, 8, 16, 1)  # fmt: skip
            c += 16
        if c + 8 <= channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1,
                     slots, 0, 0, tall_grads, at + c, row, LANES, 8, 8, 1)  # fmt: skip
            c += 8
        if c < channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1,
                     slots, 0, 0, tall_grads, at + c, row, LANES, 8, 4, 1)  # fmt: skip


@lanes
def add_slopes_of_means(splats, column, ranks, start, rows, count, cell, mean_grads, out):
    """out[m] += the cell's gradient [cells, E] times Gaussian m's cell channels, at every lane."""
    for m in range(count):
        offset = np.int64(ranks[start + rows[m]]) * splats.shape[1] + column
        slope = splat(ZERO)
        for d in range(0, mean_grads.shape[1], LANES):
            slope = fma(
                load(splats, offset + d), load(mean_grads, cell * mean_grads.shape[1] + d), slope
            )
        store(out, LANES * m, load(out, LANES * m) + splat(total(slope)))


@lanes
def record_means(shares, mean_grads, count, cell, slots, column, records):
    """records[slots[m], column:] += shares[m] times the cell's gradient."""
    for m in range(count):
        share, offset = splat(shares[m]), slots[m] * records.shape[1] + column
        for d in range(0, mean_grads.shape[1], LANES):
            slope = load(mean_grads, cell * mean_grads.shape[1] + d)
            store(records, offset + d, fma(share, slope, load(records, offset + d)))


@lanes
def clear(records, at):
    """records[at] = 0."""
    step = records.shape[1]
    for d in range(0, step - LANES + 1, LANES):
        store(records, at * step + d, splat(ZERO))
    for d in range(step // LANES * LANES, step):
        records[at, d] = ZERO


@lanes
def add_means(records, at, column, sums, i):
    """sums[i] += records[at, column:], whole vectors."""
    for d in range(0, sums.shape[1], LANES):
        offset = i * sums.shape[1] + d
        store(sums, offset, load(sums, offset) + load(records, at * records.shape[1] + column + d))


@lanes
def record_geometry(g, count, cell, slots, records):
    """records[slots[m], :6] += Σ_lanes g (1, x, y, x², xy, y²), offsets from the tile's middle."""
    at = LANES * SHAPE * cell
    for m in range(0, count, BLOCK):
        multiply(records, 0, slots, m, records.shape[1], g, LANES * m, LANES, 1,
                 slots, 0, 0, MOMENTS, at, SHAPE, LANES, 8, 8, 1)  # fmt: skip


@lanes
def whiten(records, at, shapes, k):
    """Turn a record's moments in (x, y) to (u, v), in float64: Σ g (1, u, v, u², uv, v²)."""
    p, q, r = np.float64(shapes[k, 0]), np.float64(shapes[k, 1]), np.float64(shapes[k, 2])
    u, v = np.float64(shapes[k, 3]), np.float64(shapes[k, 4])
    g_0, x, y = records[at, 0], records[at, 1], records[at, 2]
    xx, xy, yy = records[at, 3], records[at, 4], records[at, 5]
    near_u, near_v = p * x + q * y, r * y
    g_u, g_v = u * g_0 + near_u, v * g_0 + near_v
    records[at, 1], records[at, 2] = g_u, g_v
    records[at, 3] = u * (g_u + near_u) + p * (p * xx + 2 * q * xy) + q * q * yy
    records[at, 4] = u * g_v + v * near_u + r * (p * xy + q * yy)
    records[at, 5] = v * (g_v + near_v) + r * r * yy


@lanes
def record_absolute(g, count, cell, shapes, rows, slots, records):
    """Add Σ |g_x|, Σ |g_y|, the absolute gradient to the 2D means."""
    x, y, dx, dy = load(LANE_X, 0), load(LANE_Y, 0), CELL_X[cell], CELL_Y[cell]
    for m in range(count):
        k = rows[m]
        p, q, r = shapes[k, 0], shapes[k, 1], shapes[k, 2]
        u = fma(splat(p), x, fma(splat(q), y, splat(shapes[k, 3] + p * dx + q * dy)))
        v = fma(splat(r), y, splat(shapes[k, 4] + r * dy))
        slope = load(g, LANES * m) * splat(TWO)
        records[slots[m], 6] += total(magnitude(slope * splat(p) * u))
        records[slots[m], 7] += total(magnitude(slope * fma(splat(q), u, splat(r) * v)))
