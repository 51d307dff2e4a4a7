"""Compositing inside one cell: 4×4 pixels, the 16 lanes of every vector.

At an offset d from a Gaussian's mean, (u, v) = W d and log₂ α = log₂ opacity − u² − v², with W =
[[p, q], [0, r]] (see `ellipses`). A tile holds 16 cells and, for each of its Gaussians, a row of
`shapes`: p, q, r, then u and v at the middle of the tile, log₂ opacity, and from SHAPE on the
channels. Sweeping a cell lists the Gaussians that contribute to it, with α and the weight α T by
lane; what remains are products of small dense matrices, whose sums stay in registers.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import body, lanes, plain
from chebsplat.kernels.simd import (
    bits,
    fma,
    fnma,
    load,
    load_of,
    magnitude,
    scale_by_power,
    splat,
    splat_of,
    store,
    total,
    where,
)
from chebsplat.rasterize.blocks import hits_among, multiply

CELL = 4  # pixels, the side of a cell of `cell_colors`
LANES = CELL**2
load_1, load_4, splat_1 = load_of(1), load_of(4), splat_of(1)
SHAPE = 8  # floats of a row of shapes, and of a splat, before its channels
N_GEOMETRY = 8  # floats of a record before its channels (see `cell_adjoint`)
SLACK = 2  # rows of SHAPE floats or more that hold 16
BLOCK = 8  # rows of a product kept in registers at once
T_MIN, LOG2_ALPHA_MIN = np.float32(1e-4), np.float32(math.log2(1 / 255))
REACH = np.float32(math.log2(255) + 1e-3)  # beyond the ellipse α = 1/255, with slack for rounding
LN2, NEVER = np.float32(math.log(2)), np.float32(np.inf)
ZERO, ONE, TWO, SHIFT = np.float32(0), np.float32(1), np.float32(2), np.float32(1.5 * 2**23)
# Offsets of the lanes from their cell's first pixel and middle, and of the cells' middles from
# their tile's.
IN_X, IN_Y = (np.arange(LANES) % 4).astype(np.float32), (np.arange(LANES) // 4).astype(np.float32)
LANE_X, LANE_Y = IN_X - np.float32(1.5), IN_Y - np.float32(1.5)
CELL_X, CELL_Y = 4 * LANE_X, 4 * LANE_Y
_x, _y = CELL_X[:, None] + LANE_X, CELL_Y[:, None] + LANE_Y
# [cells, lanes, SHAPE]
MOMENTS = np.stack([_x**0, _x, _y, _x**2, _x * _y, _y**2, 0 * _x, 0 * _x], -1)
IN_ORDER = np.arange(BLOCK)
# 2^f on [-½, ½] to 2e-7, by Chebyshev interpolation
_nodes = 0.5 * np.cos((np.arange(6) + 0.5) * np.pi / 6)
E0, E1, E2, E3, E4, E5 = (
    np.float32(c) for c in np.polynomial.polynomial.polyfit(_nodes, 2.0**_nodes, 5)
)


@plain
def padded(channels):
    """Rounded up to fours."""
    return (channels + 3) // 4 * 4


@plain
def whole(channels):
    """Rounded up to whole vectors."""
    return (channels + LANES - 1) // LANES * LANES


@body
def corner(cell):
    """x and y of a cell's first pixel in its tile."""
    return 4 * (cell & 3), 4 * (cell >> 2)


@body
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
def begin(states, width, height):
    """Fill the states [cells, 2, 16] of a tile of which the image holds width × height pixels: T,
    which is 1, and the least log₂ α that is seen, which is infinite outside the image, and once a
    pixel is done.
    """
    for cell in range(LANES):
        left, top = corner(cell)
        inside_x = load(IN_X, 0) < splat(np.float32(width - left))
        inside_y = load(IN_Y, 0) < splat(np.float32(height - top))
        least = where(inside_x, where(inside_y, splat(LOG2_ALPHA_MIN), splat(NEVER)), splat(NEVER))
        store(states, 2 * LANES * cell, splat(ONE))
        store(states, 2 * LANES * cell + LANES, least)


@lanes
def is_done(states, cell):
    """True where no pixel of a cell takes more."""
    return bits(load(states, 2 * LANES * cell + LANES) < splat(NEVER)) == 0


@lanes
def listed(masks, at, n, cell, hits):
    """Rows of masks[at : at + n] with this cell, into `hits`; their count. Both have 16 more."""
    count = 0
    for k in range(0, n, LANES):
        count = hits_among(masks, at + k, n - k, cell, k, hits, count)
    return count


@body
def _exp2(power):
    """2^power, for -100 <= power <= 100; anything below."""
    shifted = power + splat(SHIFT)
    f = power - (shifted - splat(SHIFT))
    series = fma(
        f,
        fma(f, fma(f, fma(f, fma(f, splat(E5), splat(E4)), splat(E3)), splat(E2)), splat(E1)),
        splat(E0),
    )
    return scale_by_power(series, shifted)


@lanes
def sweep(shapes, hits, n, cell, max_alpha, states, alphas, weights, rows):
    """Composite one cell front to back, α and α T of what contributes into rows [16] of `alphas`
    and `weights`.

    Args: hits [n] rows of `shapes`; states as `begin` fills them; alphas, weights and rows have
      room for n.
    Returns: count of those that contribute; rows[:count] are their rows.
    Choices: no branch on whether a Gaussian contributes: the next one's row takes its place where
      it does not.
    """
    x, y = load(LANE_X, 0) + splat(CELL_X[cell]), load(LANE_Y, 0) + splat(CELL_Y[cell])
    t, least = load(states, 2 * LANES * cell), load(states, 2 * LANES * cell + LANES)
    count = 0
    for j in range(n):
        k = hits[j]
        u = fma(splat(shapes[k, 0]), x, fma(splat(shapes[k, 1]), y, splat(shapes[k, 3])))
        v = fma(splat(shapes[k, 2]), y, splat(shapes[k, 4]))
        power = fnma(u, u, fnma(v, v, splat(shapes[k, 5])))
        visible, alpha = power >= least, _exp2(power)
        alpha = where(
            visible, where(alpha < splat(max_alpha), alpha, splat(max_alpha)), splat(ZERO)
        )
        after = fnma(alpha, t, t)
        closing = after <= splat(T_MIN)
        if bits(closing) != 0:  # those pixels are done, without this Gaussian
            alpha, after = where(closing, splat(ZERO), alpha), where(closing, t, after)
            least = where(closing, splat(NEVER), least)
            if bits(least < splat(NEVER)) == 0:
                break
        store(alphas, LANES * count, alpha)
        store(weights, LANES * count, alpha * t)
        rows[count] = k
        count += bits(visible) != 0
        t = after
    store(states, 2 * LANES * cell, t)
    store(states, 2 * LANES * cell + LANES, least)
    return count


@lanes
def accumulate(shapes, rows, weights, count, cell, sums):
    """sums[cell, c] += Σ_m shapes[rows[m], SHAPE + c] weights[m]: [cells, channels, 16]."""
    channels, step = sums.shape[1], shapes.shape[1]
    for c in range(0, channels - 7, BLOCK):
        at = LANES * (cell * channels + c)
        multiply(sums, at, IN_ORDER, 0, LANES, shapes, SHAPE + c, 1, step, rows, 0, 2,
                 weights, 0, LANES, count, 8, LANES, 1)  # fmt: skip
    if channels % BLOCK != 0:
        c = channels - 4
        at = LANES * (cell * channels + c)
        multiply(sums, at, IN_ORDER, 0, LANES, shapes, SHAPE + c, 1, step, rows, 0, 2,
                 weights, 0, LANES, count, 4, LANES, 1)  # fmt: skip


@lanes
def sum_lanes(weights, count, sums):
    """sums[m] = Σ_lanes weights[m]: what Gaussian m adds to the whole cell."""
    for m in range(count):
        sums[m] = total(load(weights, LANES * m))


@lanes
def accumulate_means(splats, column, ranks, start, rows, shares, count, cell, sums):
    """sums[cell] += Σ_m shares[m] splats[m, column:]: cell channels [cells, E], E in sixteens."""
    for d in range(0, sums.shape[1], LANES):
        at = cell * sums.shape[1] + d
        summed = load(sums, at)
        for m in range(count):
            offset = np.int64(ranks[start + rows[m]]) * splats.shape[1] + column + d
            summed = fma(splat(shares[m]), load(splats, offset), summed)
        store(sums, at, summed)


@lanes
def copy(a, a_at, n, b, b_at):
    """b.flat[b_at : b_at + n] = a.flat[a_at : a_at + n]."""
    k = 0
    while k + LANES <= n:
        store(b, b_at + k, load(a, a_at + k))
        k += LANES
    while k + 4 <= n:
        store(b, b_at + k, load_4(a, a_at + k))
        k += 4
    while k < n:
        store(b, b_at + k, load_1(a, a_at + k))
        k += 1


@lanes
def copy_whole(a, a_at, n, b, b_at):
    """As `copy`, but in whole vectors: up to 15 more."""
    for k in range(0, n, LANES):
        store(b, b_at + k, load(a, a_at + k))


@lanes
def clear(a, at, n):
    """a.flat[at : at + n] = 0."""
    for k in range(at, at + n):
        store(a, k, splat_1(ZERO))


@lanes
def is_finite(a, at, n):
    """True where all of a.flat[at : at + n] is finite; n a multiple of LANES."""
    sums = splat(ZERO)
    for k in range(0, n, LANES):
        sums = fma(load(a, at + k), splat(ZERO), sums)
    return total(sums) == ZERO
