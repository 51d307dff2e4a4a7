"""Compositing and its adjoint inside one cell: 4×4 pixels, the 16 lanes of every vector.

At an offset d from a Gaussian's mean, (u, v) = W d and log₂ α = log₂ opacity − u² − v², with W = [[p, q], [0, r]] (see
`ellipses`). A tile holds 16 cells and, for each of its Gaussians, a row of `shapes`: p, q, r, then u and v at the
middle of the tile, then log₂ opacity. Sweeping a cell lists the Gaussians that contribute to it, with α and the weight
α T by lane; what remains are products of small dense matrices, whose sums stay in registers.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import inline, lanes
from chebsplat.kernels.simd import bits, fma, fnma, load, magnitude, scale_by_power, splat, store, total, where
from chebsplat.rasterize.blocks import multiply

LANES = 16
SHAPE = 8  # floats of a row of shapes, and of a splat before its channels
N_GEOMETRY = 8  # of a record: Σg, Σgu, Σgv, Σgu², Σguv, Σgv², Σ|g_x|, Σ|g_y|, where g = dL/d(log₂ α)
SLACK = 4  # rows of four floats or more that hold 16
BLOCK = 8  # rows of a product kept in registers at once
AHEAD = 3  # Gaussians whose α are computed together with one
T_MIN, ALPHA_MIN = np.float32(1e-4), np.float32(1 / 255)
REACH = np.float32(math.log2(255) + 1e-3)  # beyond the ellipse α = 1/255, with slack for rounding
LN2, FAINT, NEVER = np.float32(math.log(2)), np.float32(-20), np.float32(np.inf)
ZERO, ONE, TWO, SHIFT = np.float32(0), np.float32(1), np.float32(2), np.float32(1.5 * 2**23)
# Offsets of the lanes from their cell's middle, and of the cells from their tile's.
LANE_X = (np.arange(LANES) % 4 - 1.5).astype(np.float32)
LANE_Y = (np.arange(LANES) // 4 - 1.5).astype(np.float32)
CELL_X, CELL_Y = 4 * LANE_X, 4 * LANE_Y
_x, _y = CELL_X[:, None] + LANE_X, CELL_Y[:, None] + LANE_Y
MOMENTS = np.stack([_x**0, _x, _y, _x**2, _x * _y, _y**2, 0 * _x, 0 * _x], -1)  # [cells, lanes, SHAPE]
IN_ORDER = np.arange(BLOCK)
# 2^f on [-½, ½] to 2e-7, by Chebyshev interpolation
_nodes = 0.5 * np.cos((np.arange(6) + 0.5) * np.pi / 6)
E0, E1, E2, E3, E4, E5 = (np.float32(c) for c in np.polynomial.polynomial.polyfit(_nodes, 2.0**_nodes, 5))


@inline
def padded(channels):
    """Rounded up to fours."""
    return (channels + 3) // 4 * 4


@inline
def whole(channels):
    """Rounded up to whole vectors."""
    return (channels + LANES - 1) // LANES * LANES


@inline
def _larger(a, b):
    return where(a > b, a, b)


@lanes
def reach(shapes, k):
    """The cells of the tile that Gaussian k's ellipse may reach, as bits."""
    p, q, r = shapes[k, 0], shapes[k, 1], shapes[k, 2]
    x, y = load(CELL_X, 0), load(CELL_Y, 0)
    u = fma(splat(p), x, fma(splat(q), y, splat(shapes[k, 3])))
    v = fma(splat(r), y, splat(shapes[k, 4]))
    far_u = _larger(magnitude(u) - splat(np.float32(1.5) * (p + abs(q))), splat(ZERO))
    far_v = _larger(magnitude(v) - splat(np.float32(1.5) * r), splat(ZERO))
    return bits(fma(far_u, far_u, far_v * far_v) <= splat(shapes[k, 5] + REACH))


@lanes
def listed(masks, at, n, cell, hits):
    """Which of masks[at : at + n] hold this cell, into `hits`, with AHEAD valid rows after them; returns how many."""
    count = 0
    for k in range(n):
        hits[count] = k
        count += (masks[at + k] >> cell) & 1
    for k in range(AHEAD):
        hits[count + k] = 0
    return count


@inline
def _alpha(shapes, k, x, y, dx, dy, ceiling):
    """α of Gaussian k at the lanes of the cell whose middle is (dx, dy) from the tile's: 2^power, at most `ceiling`."""
    p, q, r = shapes[k, 0], shapes[k, 1], shapes[k, 2]
    u = fma(splat(p), x, fma(splat(q), y, splat(shapes[k, 3] + p * dx + q * dy)))
    v = fma(splat(r), y, splat(shapes[k, 4] + r * dy))
    power = _larger(splat(shapes[k, 5]) - fma(u, u, v * v), splat(FAINT))
    shifted = power + splat(SHIFT)
    f = power - (shifted - splat(SHIFT))
    series = fma(f, fma(f, fma(f, fma(f, fma(f, splat(E5), splat(E4)), splat(E3)), splat(E2)), splat(E1)), splat(E0))
    alpha = scale_by_power(series, shifted)
    return where(alpha < ceiling, alpha, ceiling)


@lanes
def sweep(shapes, hits, n, cell, max_alpha, states, alphas, weights, rows):
    """Composite one cell front to back, α and α T of what contributes into rows [16] of `alphas` and `weights`.

    Args: hits [n + AHEAD] rows of `shapes`; states [cells, 2, 16]: transmittance, and the T at which a pixel is done,
      which is infinite once it is, or outside the image; alphas holds AHEAD more rows than the others.
    Returns: how many contribute; rows[:count] says which.
    """
    x, y, dx, dy = load(LANE_X, 0), load(LANE_Y, 0), CELL_X[cell], CELL_Y[cell]
    t, done_at = load(states, 2 * LANES * cell), load(states, 2 * LANES * cell + LANES)
    count, n_open = 0, 1
    for first in range(0, n, AHEAD + 1):
        for j in range(first, first + AHEAD + 1):  # none waits for another, as the transmittances below do
            store(alphas, LANES * j, _alpha(shapes, hits[j], x, y, dx, dy, splat(max_alpha)))
        for j in range(first, min(first + AHEAD + 1, n)):
            alpha = load(alphas, LANES * j)  # what is stored below never passes row j
            visible = alpha >= splat(ALPHA_MIN)
            if bits(visible) == 0:
                continue
            alpha = where(visible, alpha, splat(ZERO))
            after = fnma(alpha, t, t)
            is_open = after > done_at
            alpha = where(is_open, alpha, splat(ZERO))
            store(alphas, LANES * count, alpha)
            store(weights, LANES * count, alpha * t)
            rows[count] = hits[j]
            count += 1
            t, done_at = where(is_open, after, t), where(is_open, done_at, splat(NEVER))
            n_open = bits(is_open)
            if n_open == 0:
                break
        if n_open == 0:
            break
    store(states, 2 * LANES * cell, t)
    store(states, 2 * LANES * cell + LANES, done_at)
    return count


@lanes
def gather(splats, ranks, start, rows, count, chosen):
    """chosen[m] = the channels of splat ranks[start + rows[m]], 16 floats at a time: `chosen` needs SLACK more rows."""
    step = chosen.shape[1]
    for m in range(count):
        at = np.int64(ranks[start + rows[m]]) * splats.shape[1] + SHAPE
        for d in range(0, step, LANES):
            store(chosen, m * step + d, load(splats, at + d))


@lanes
def accumulate(chosen, weights, count, cell, sums):
    """sums[cell, c] += Σ_m chosen[m, c] weights[m]: [cells, channels, 16], channels a multiple of four."""
    channels, step = sums.shape[1], chosen.shape[1]
    for c in range(0, channels - 7, BLOCK):
        at = LANES * (cell * channels + c)
        multiply(sums, at, IN_ORDER, 0, LANES, chosen, c, 1, step, weights, 0, LANES, count, 8, 16, 1)
    if channels % BLOCK != 0:
        at = LANES * (cell * channels + channels - 4)
        multiply(sums, at, IN_ORDER, 0, LANES, chosen, channels - 4, 1, step, weights, 0, LANES, count, 4, 16, 1)


@lanes
def slopes(chosen, grads, count, cell, depth, out):
    """out[m] = dL/d(weight m) by lane: the image's gradients [cells, depth, 16] times a Gaussian's row of `chosen`."""
    at, step = LANES * cell * grads.shape[1], chosen.shape[1]
    for m in range(0, count, BLOCK):
        multiply(out, LANES * m, IN_ORDER, 0, LANES, chosen, m * step, step, 1, grads, at, LANES, depth, 8, 16, 0)


@lanes
def unwind(alphas, weights, out, count, max_alpha):
    """Turn dL/d(weight) into g = dL/d(log₂ α), in place, back to front.

    With B the slope of all that lies behind, as seen through it alone, dL/dα = T (slope − B) and B moves to
    B + α (slope − B) in front: no division by 1 − α.
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
    """records[slots[m], N_GEOMETRY:] += Σ_lanes weights[m] tall_grads: by cell, 16 rows of D `channels` and a margin.

    The records have a multiple of four columns for them; what the last ones take up beyond D is never read.
    """
    row, at, step = channels, cell * (LANES * channels + LANES), records.shape[1]
    channels = padded(channels)
    for m in range(0, count, BLOCK):
        c = 0
        while c + 16 <= channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1, tall_grads, at + c,
                     row, LANES, 8, 16, 1)  # fmt: skip
            c += 16
        if c + 8 <= channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1, tall_grads, at + c,
                     row, LANES, 8, 8, 1)  # fmt: skip
            c += 8
        if c < channels:
            multiply(records, N_GEOMETRY + c, slots, m, step, weights, LANES * m, LANES, 1, tall_grads, at + c,
                     row, LANES, 8, 4, 1)  # fmt: skip


@lanes
def sum_lanes(weights, count, sums):
    """sums[m] = Σ_lanes weights[m]: what Gaussian m adds to the whole cell."""
    for m in range(count):
        sums[m] = total(load(weights, LANES * m))


@lanes
def accumulate_means(splats, column, ranks, start, rows, shares, count, cell, sums):
    """sums[cell] += Σ_m shares[m] splats[m, column:]: the cell channels, [cells, E], E a multiple of 16."""
    for d in range(0, sums.shape[1], LANES):
        at = cell * sums.shape[1] + d
        summed = load(sums, at)
        for m in range(count):
            offset = np.int64(ranks[start + rows[m]]) * splats.shape[1] + column + d
            summed = fma(splat(shares[m]), load(splats, offset), summed)
        store(sums, at, summed)


@lanes
def add_slopes_of_means(splats, column, ranks, start, rows, count, cell, mean_grads, out):
    """out[m] += the cell's gradient [cells, E] times Gaussian m's cell channels, the same at every lane."""
    for m in range(count):
        offset = np.int64(ranks[start + rows[m]]) * splats.shape[1] + column
        slope = splat(ZERO)
        for d in range(0, mean_grads.shape[1], LANES):
            slope = fma(load(splats, offset + d), load(mean_grads, cell * mean_grads.shape[1] + d), slope)
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
        multiply(records, 0, slots, m, records.shape[1], g, LANES * m, LANES, 1, MOMENTS, at, SHAPE, LANES, 8, 8, 1)


@lanes
def whiten(records, at, shapes, k):
    """Turn a record's moments in (x, y) into those in (u, v), in float64: Σ g (1, u, v, u², uv, v²)."""
    p, q, r = np.float64(shapes[k, 0]), np.float64(shapes[k, 1]), np.float64(shapes[k, 2])
    u, v = np.float64(shapes[k, 3]), np.float64(shapes[k, 4])
    g_0, x, y, xx, xy, yy = (
        records[at, 0], records[at, 1], records[at, 2], records[at, 3], records[at, 4], records[at, 5]
    )  # fmt: skip
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


@lanes
def copy(a, a_at, n, b, b_at):
    """b[b_at : b_at + n] = a[a_at : a_at + n] of flat arrays."""
    k = 0
    while k + LANES <= n:
        store(b, b_at + k, load(a, a_at + k))
        k += LANES
    while k < n:
        b[b_at + k] = a[a_at + k]
        k += 1


@lanes
def is_finite(a, at, n):
    """Whether all of a.flat[at : at + n] is finite; n a multiple of 16."""
    sums = splat(ZERO)
    for k in range(0, n, LANES):
        sums = fma(load(a, at + k), splat(ZERO), sums)
    return total(sums) == ZERO
