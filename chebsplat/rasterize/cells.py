"""Compositing inside one cell: 4×4 pixels, the 16 lanes of every vector.

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
N_GEOMETRY = 8  # floats of a record before its channels (see `cell_adjoint`)
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
