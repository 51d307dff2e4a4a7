"""Operator and centred Chebyshev recurrence of many regions in one compiled loop (Eqs 2-6): the
fast twin of `descriptor_reference.describe`. Matrices are as in `albo_kernel`.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import kernel, serial
from chebsplat.kernels.simd import fma, load, splat, spread, store
from chebsplat.shape.albo_kernel import (
    LEAST_BANDWIDTH,
    LEAST_DEGREE,
    exact_operator,
    mirror,
    operator,
)
from chebsplat.shape.region_frame import canonical, metric, tangent_axis, turn_back

FINEST = np.float32(-0.5 / LEAST_BANDWIDTH**2 / math.log(2.0))
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@serial
def next_term(x, term, before, at_zero, count, n, out):
    """out = 2 x term + 2 T_m(0) x − before: the recurrence of E_m = T_m − T_m(0) I."""
    twice, shift = splat(TWO), splat(TWO * at_zero)
    for j in range(0, n, 16):
        for i in range(0, j + 16, 8):
            a = b = c = d = e = f = g = h = splat(ZERO)
            for k in range(count):
                row, s = load(term, k * n + j), k * n + i
                a, b = fma(spread(x, s), row, a), fma(spread(x, s + 1), row, b)
                c, d = fma(spread(x, s + 2), row, c), fma(spread(x, s + 3), row, d)
                e, f = fma(spread(x, s + 4), row, e), fma(spread(x, s + 5), row, f)
                g, h = fma(spread(x, s + 6), row, g), fma(spread(x, s + 7), row, h)
            s = i * n + j
            for value in (a, b, c, d, e, f, g, h):
                rest = (shift * load(x, s)) - load(before, s)
                store(out, s, fma(twice, value, rest))
                s += n
    mirror(out, n)


@serial
def row_products(a, b, count, n, out, start):
    """Diagonal of a b into out[start:], by columns, which are rows of a symmetric matrix."""
    for j in range(0, n, 16):
        sums = splat(ZERO)
        for i in range(count):
            sums = fma(load(a, i * n + j), load(b, i * n + j), sums)
        store(out, start + j, sums)


@serial
def diagonals(terms, u, max_degree, count, n, out):
    """n ([T_d(−S)]_ii − T_d(0)) of degrees 2...max_degree into out [D - 1, n], from terms[1] = u uᵀ
    − S.

    T_d(−S) = T_d(u uᵀ − S) + (T_d(−1) − T_d(0)) u uᵀ, because S u = u; u may be zero.
    """
    for m in range(1, (max_degree + 1) // 2):
        at_zero = ZERO if m % 2 else (ONE if m % 4 == 0 else -ONE)
        next_term(terms[1], terms[m], terms[m - 1], at_zero, count, n, terms[m + 1])
    for degree in range(2, max_degree + 1):
        m = degree // 2
        k = degree - m
        start = (degree - 2) * n
        row_products(terms[m], terms[k], count, n, out, start)
        m_zero = ZERO if m % 2 else (ONE if m % 4 == 0 else -ONE)
        k_zero = ZERO if k % 2 else (ONE if k % 4 == 0 else -ONE)
        sign = -ONE if degree % 2 else ONE
        lead = sign - (ZERO if degree % 2 else (ONE if degree % 4 == 0 else -ONE))
        for i in range(count):
            at = i * n + i
            value = (
                TWO * (out[start + i] + m_zero * terms[k, at] + k_zero * terms[m, at])
                - terms[k - m, at]
            )
            out[start + i] = np.float32(count) * (value + lead * u[i] * u[i])


@serial
def pair_angles(values, certainty, index, count, n, out):
    """Half the sum and difference of angles j and J − j, faded by certainty, into out [slots, J, D
    - 1].

    Args: values [J, (D - 1) n], only the first angle filled where certainty is 0.
    """
    n_angles, n_degrees = out.shape[1], out.shape[2]
    certainty = np.float32(certainty)
    for i in range(count):
        for d in range(n_degrees):
            at = d * n + i
            first = values[0, at]
            out[index[i], 0, d] = first
            for j in range(1, n_angles):
                if j <= n_angles - j:
                    value = first
                    if certainty > ZERO:
                        mean = HALF * (values[j, at] + values[n_angles - j, at])
                        value = first + certainty * (mean - first)
                else:
                    value = ZERO
                    if certainty > ZERO:
                        value = certainty * HALF * abs(values[n_angles - j, at] - values[j, at])
                out[index[i], j, d] = value


@kernel
def describe(first, last, means, scales, rotmats, mask, anisotropy, bandwidth, out, exact):
    """Descriptors of regions first...last − 1 into out f32 [M, n, J, D - 1]; exact [M]: took the
    float64 operator.

    Args: float64 means, scales [M, n, 3], rotmats [M, n, 3, 3]; mask [M, n] bool; out and exact
      zero.
    """
    size, n_angles, max_degree = mask.shape[1], out.shape[2], out.shape[3] + 1
    widest = (size + 15) // 16 * 16
    scale = np.float32(-0.5 / bandwidth**2 / math.log(2.0))
    index, largest, axis = np.empty(size, np.int64), np.empty(size), np.empty(3)
    points, turned, sizes = np.empty((size, 3)), np.empty((size, 3)), np.empty((size, 3))
    frames, factors = np.empty((size, 3, 3)), np.empty((size, 3, 3))
    split, metrics = np.empty(6 * widest, np.float32), np.empty(9 * widest, np.float32)
    u, degrees, values = (
        np.empty(widest, np.float32),
        np.empty(2 * widest, np.float32),
        np.empty((n_angles, (max_degree - 1) * widest), np.float32),
    )
    terms = np.empty(((max_degree + 1) // 2 + 1, widest * widest), np.float32)
    for r in range(first, last):
        count = canonical(means[r], scales[r], rotmats[r], mask[r], index, points, sizes, frames)
        if count < 2:  # no edge: zero
            continue
        n = (count + 15) // 16 * 16
        metric(sizes, frames, count, anisotropy, largest, factors)
        certainty = tangent_axis(points, sizes, frames, count, axis)
        metrics[:] = ZERO
        for i in range(count):
            for k in range(3):
                for j in range(3):
                    metrics[(3 * k + j) * n + i] = factors[i, k, j]
        for i in range(n * n):
            terms[0, i] = ZERO
        for j in range(n_angles if certainty > 0.0 else 1):
            turn_back(points, count, axis, 2.0 * math.pi * j / n_angles, turned)
            least = (
                operator(turned, metrics, count, n, scale, split, degrees, u, terms[1])
                if scale > FINEST
                else ZERO
            )
            if least < LEAST_DEGREE:
                exact_operator(turned, factors, count, n, bandwidth, u, terms[1])
                exact[r] = True
            diagonals(terms, u, max_degree, count, n, values[j])
        pair_angles(values, certainty, index, count, n, out[r])
