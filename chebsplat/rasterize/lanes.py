"""Loops over the 16 lanes of a cell: the arithmetic of compositing, each loop a vector instruction or two.

A tile of 16×16 pixels is 16 cells of 4×4 pixels, the lanes. At a lane's offset d from the mean, (u, v) = W d and
log₂ α = log₂ opacity − u² − v², with W = [[p, q], [0, r]] (see `ellipses`). The functions here take (u, v) at the
tile's first pixel centre, and list a Gaussian's cells in `cells[first : first + n]`.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.jit import inline, lanes, serial

LANES, LAST = 16, 15  # `& LAST` tells the compiler that an index is not negative, `& LANES` that a loop is 0 or 16 long
T_MIN = np.float32(1e-4)
ALPHA_MIN = np.float32(1 / 255)
LOG2_255 = np.float32(math.log2(255) + 1e-3)
LN2 = np.float32(math.log(2))
N_GEOMETRY = 8  # of a record: Σg, Σgu, Σgv, Σgu², Σguv, Σgv², Σ|g_x|, Σ|g_y|, where g = dL/d(log₂ α)
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
# 2^f on [-½, ½] to 2e-7, by Chebyshev interpolation
_nodes = 0.5 * np.cos((np.arange(6) + 0.5) * np.pi / 6)
E0, E1, E2, E3, E4, E5 = (np.float32(c) for c in np.polynomial.polynomial.polyfit(_nodes, 2.0**_nodes, 5))


@inline
def _exp2(x):
    """2^x for -100 < x < 100, in arithmetic that vectorises."""
    shifted = np.int32(x + np.float32(128.5))
    f = x - (np.float32(shifted) - np.float32(128))
    power = np.int32((shifted - np.int32(1)) << np.int32(23)).view(np.float32)
    return (E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))) * power


@serial
def places():
    """Offsets of a cell's lanes, x and y, then of the middles of a tile's cells: [4, lanes]."""
    offsets = np.empty((4, LANES), np.float32)
    for lane in range(LANES):
        offsets[0, lane], offsets[1, lane] = lane & 3, lane >> 2
        offsets[2, lane], offsets[3, lane] = 4 * (lane & 3) + 1.5, 4 * (lane >> 2) + 1.5
    return offsets


@lanes
def reach(u, v, p, q, r, limit, offsets, alive, hits, cells, first):
    """List the living cells that the ellipse may reach; u, v whiten the tile's first pixel centre."""
    half_u, half_v = np.float32(1.5) * (p + abs(q)), np.float32(1.5) * r
    for cell in range(offsets.shape[1] & LANES):
        far_u = max(abs(u + p * offsets[2, cell] + q * offsets[3, cell]) - half_u, ZERO)
        far_v = max(abs(v + r * offsets[3, cell]) - half_v, ZERO)
        hits[cell] = alive[cell] if far_u * far_u + far_v * far_v <= limit else 0
    n = first
    for cell in range(LANES):
        cells[n] = cell
        n += hits[cell]
    return n - first


@lanes
def blend(u, v, p, q, r, log_opacity, max_alpha, offsets, cells, first, n, before, alphas, fronts, alive):
    """α and the transmittance in front, [n, lanes], of one Gaussian in its cells; 0 where it does not contribute.

    Returns: the number of cells that it completes.
    """
    n_done = 0
    for k in range(first, first + n):
        cell = cells[k] & LAST
        u_cell = u + p * np.float32(4 * (cell & 3)) + q * np.float32(4 * (cell >> 2))
        v_cell = v + r * np.float32(4 * (cell >> 2))
        n_open = 0
        for lane in range(offsets.shape[1] & LANES):
            u_lane, v_lane = u_cell + p * offsets[0, lane] + q * offsets[1, lane], v_cell + r * offsets[1, lane]
            power = max(log_opacity - u_lane * u_lane - v_lane * v_lane, np.float32(-20))
            alpha = min(_exp2(power), max_alpha)
            alpha = alpha if alpha >= ALPHA_MIN else ZERO
            t = before[cell, lane]
            after = t * (ONE - alpha)
            is_open = after > T_MIN
            alphas[k, lane], fronts[k, lane] = alpha if is_open else ZERO, t
            before[cell, lane] = after if is_open else -abs(t)
            n_open += int(is_open)
        if n_open == 0:
            alive[cell] = 0
            n_done += 1
    return n_done


@lanes
def accumulate(alphas, fronts, weights, cells, n, colors, i, sums):
    for k in range(n):
        cell = cells[k] & LAST
        for lane in range(weights.shape[0] & LANES):
            weights[lane] = alphas[k, lane] * fronts[k, lane]
        for d in range(colors.shape[1]):
            color = colors[i, d]
            for lane in range(weights.shape[0] & LANES):
                sums[cell, d, lane] += weights[lane] * color


@lanes
def by_channel(alphas, fronts, cells, first, n, color, grads, tall_grads, by_alpha, slopes, weights, by_colors):
    """slopes [n, lanes] = dL/d(weight) in one Gaussian's cells, and its dL/d(color) by lane into by_colors.

    Args: grads [cells, D, lanes] and tall_grads [cells, lanes, D'] of the image, color [D'], where D' is D filled up
      with zeros to a multiple of 8: a dot product that stores nothing needs no check for overlap.
    """
    for d in range(by_colors.shape[0]):
        for lane in range(weights.shape[0] & LANES):
            by_colors[d, lane] = ZERO
    for k in range(n):
        cell = cells[first + k] & LAST
        for lane in range(LANES):
            slope = by_alpha[cell, lane]
            for d in range(color.shape[0] & -8):
                slope += color[d] * tall_grads[cell, lane, d]
            slopes[k, lane] = slope
        for lane in range(weights.shape[0] & LANES):
            weights[lane] = alphas[first + k, lane] * fronts[first + k, lane]
        for d in range(by_colors.shape[0]):
            for lane in range(weights.shape[0] & LANES):
                by_colors[d, lane] += weights[lane] * grads[cell, d, lane]


@lanes
def by_geometry(u, v, p, q, r, max_alpha, offsets, cells, first, n, alphas, fronts, slopes, behind, record):
    """The first N_GEOMETRY entries of one record; `behind` [cells, lanes] is what the pixels gain behind it."""
    g_0 = g_u = g_v = g_uu = g_uv = g_vv = g_x = g_y = ZERO
    for k in range(n):
        cell = cells[first + k] & LAST
        u_cell = u + p * np.float32(4 * (cell & 3)) + q * np.float32(4 * (cell >> 2))
        v_cell = v + r * np.float32(4 * (cell >> 2))
        for lane in range(offsets.shape[1] & LANES):
            u_lane, v_lane = u_cell + p * offsets[0, lane] + q * offsets[1, lane], v_cell + r * offsets[1, lane]
            alpha, gain, back = alphas[first + k, lane], fronts[first + k, lane] * slopes[k, lane], behind[cell, lane]
            behind[cell, lane] = back + alpha * gain
            g = LN2 * alpha * (gain - back / (ONE - alpha))
            g = g if alpha < max_alpha else ZERO
            along_u, along_v = g * u_lane, g * v_lane
            g_0 += g
            g_u += along_u
            g_v += along_v
            g_uu += along_u * u_lane
            g_uv += along_u * v_lane
            g_vv += along_v * v_lane
            g_x += abs(TWO * p * along_u)
            g_y += abs(TWO * (q * along_u + r * along_v))
    record[0], record[1], record[2], record[3] = g_0, g_u, g_v, g_uu
    record[4], record[5], record[6], record[7] = g_uv, g_vv, g_x, g_y


@lanes
def sum_lanes(by_colors, record):
    for d in range(by_colors.shape[0]):
        total = ZERO
        for lane in range(by_colors.shape[1] & LANES):
            total += by_colors[d, lane]
        record[N_GEOMETRY + d] = total
