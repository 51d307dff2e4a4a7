"""The symmetric operator u uᵀ − S of a region in float32 (Eqs 2-3): fast twin of `albo.similarity`.

S u = u for u_i = sqrt(A_i / Σ A). Without that pair the spectrum of a well connected region keeps
off ±1, where T_d multiplies rounding errors by d² rather than by d.

Matrices are [n, n] stored flat, where n is the member count filled up to a multiple of 16. All are
symmetric: what fills one fills the blocks on and above the diagonal and mirrors them. Sums are
carried out as written: no function here may be compiled with reassociation.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import serial
from chebsplat.kernels.simd import exp2, fma, load, splat, spread, store, transpose

# Below this degree or bandwidth exponents are large enough for float32 to lose digits: the operator
# is then built in float64 and in logarithms.
LEAST_DEGREE, LEAST_BANDWIDTH = np.float32(1e-3), 0.05
ZERO = np.float32(0)


@serial
def mirror(a, n):
    """Copy the transposed blocks above the diagonal to below it."""
    for i in range(0, n, 16):
        for j in range(i + 16, n, 16):
            transpose(a, i * n + j, j * n + i, n)


@serial
def weights(points, factors, count, n, scale, out):
    """w_ij = 2^(scale (|Y_i Δ|² + |Y_j Δ|²)) into out [n, n], 0 on the diagonal and where padded.

    Args: points [6, n], coordinates in two float32 each, so that differences keep every digit;
      factors [9, n].
    """
    factor = splat(scale)
    for j in range(0, n, 16):
        xj, yj, zj = load(points, j), load(points, n + j), load(points, 2 * n + j)
        uj, vj, wj = load(points, 3 * n + j), load(points, 4 * n + j), load(points, 5 * n + j)
        m0, m1, m2 = load(factors, j), load(factors, n + j), load(factors, 2 * n + j)
        m3, m4, m5 = load(factors, 3 * n + j), load(factors, 4 * n + j), load(factors, 5 * n + j)
        m6, m7, m8 = load(factors, 6 * n + j), load(factors, 7 * n + j), load(factors, 8 * n + j)
        for i in range(min(j + 16, count)):
            x = (xj - spread(points, i)) + (uj - spread(points, 3 * n + i))
            y = (yj - spread(points, n + i)) + (vj - spread(points, 4 * n + i))
            z = (zj - spread(points, 2 * n + i)) + (wj - spread(points, 5 * n + i))
            a, b, c = m0 * x, m3 * x, m6 * x
            a, b, c = fma(m1, y, a), fma(m4, y, b), fma(m7, y, c)
            a, b, c = fma(m2, z, a), fma(m5, z, b), fma(m8, z, c)
            of_j = fma(a, a, fma(b, b, c * c))
            a, b, c = (
                spread(factors, i) * x,
                spread(factors, 3 * n + i) * x,
                spread(factors, 6 * n + i) * x,
            )
            a, b = fma(spread(factors, n + i), y, a), fma(spread(factors, 4 * n + i), y, b)
            c = fma(spread(factors, 7 * n + i), y, c)
            a, b = fma(spread(factors, 2 * n + i), z, a), fma(spread(factors, 5 * n + i), z, b)
            c = fma(spread(factors, 8 * n + i), z, c)
            of_i = fma(a, a, fma(b, b, c * c))
            store(out, i * n + j, exp2(factor * (of_i + of_j)))
        for i in range(count, j + 16):
            store(out, i * n + j, splat(ZERO))
    for i in range(count):
        out[i * n + i] = ZERO
        for j in range(count, n):
            out[i * n + j] = ZERO
    mirror(out, n)


@serial
def column_sums(a, count, n, out):
    """Column sums into out [n], and the excess of their rounding into out [n:]."""
    for j in range(0, n, 16):
        sums, lost = splat(ZERO), splat(ZERO)
        for i in range(count):
            term = load(a, i * n + j) - lost
            larger = sums + term
            lost = (larger - sums) - term
            sums = larger
        store(out, j, sums)
        store(out, n + j, lost)


@serial
def normalise(a, roots, u, count, n):
    """a_ij <- u_i u_j − a_ij roots_i roots_j, rounded about once; roots: two float32 each."""
    for i in range(count):
        root, rest, lead = splat(-roots[i]), splat(-roots[n + i]), splat(u[i])
        for j in range(0, n, 16):
            other, w = load(roots, j), load(a, i * n + j)
            product = root * other
            lost = fma(root, other, splat(ZERO) - product)
            lost = fma(root, load(roots, n + j), fma(rest, other, lost))
            store(a, i * n + j, fma(w, product, fma(lead, load(u, j), w * lost)))


@serial
def operator(points, metrics, count, n, scale, split, degrees, u, out):
    """u uᵀ − S into out [n, n], u [n], unless a degree is too small. Returns the least degree."""
    split[:] = ZERO
    for i in range(count):
        for k in range(3):
            high = np.float32(points[i, k])
            split[k * n + i] = high
            split[(3 + k) * n + i] = np.float32(points[i, k] - high)
    weights(split, metrics, count, n, scale, out)
    column_sums(out, count, n, degrees)
    least = degrees[0]
    for i in range(1, count):
        least = min(least, degrees[i])
    if least >= LEAST_DEGREE:
        total = 0.0
        for i in range(count):
            total += float(degrees[i]) - float(degrees[n + i])
        for i in range(n):
            degree = float(degrees[i]) - float(degrees[n + i]) if i < count else 1.0
            root = 1.0 / math.sqrt(degree) if i < count else 0.0
            degrees[i], degrees[n + i] = np.float32(root), np.float32(root - np.float32(root))
            u[i] = np.float32(math.sqrt(degree / total)) if i < count else ZERO
        normalise(out, degrees, u, count, n)
    return least


@serial
def exact_operator(points, factors, count, n, bandwidth, u, out):
    """−S in float64 and logarithms, rounded once: right where every weight of a member underflows.

    Here u = 0: a region like this falls apart into parts that each have a pair at −1, and zeros are
    exact.
    Args: points [n, 3], factors [n, 3, 3].
    """
    lengths, logs = np.empty((count, count)), np.empty(count)
    for i in range(count):
        lengths[i, i] = -np.inf
        for j in range(i):
            total = 0.0
            for side in (i, j):
                for k in range(3):
                    along = 0.0
                    for axis in range(3):
                        along += factors[side, k, axis] * (points[i, axis] - points[j, axis])
                    total += along * along
            lengths[i, j] = lengths[j, i] = -0.5 * total / bandwidth**2
    for i in range(count):
        top = -np.inf
        for j in range(count):
            top = max(top, lengths[i, j])
        total = 0.0
        for j in range(count):
            total += math.exp(lengths[i, j] - top)
        logs[i] = 0.5 * (top + math.log(total))
    out[: n * n], u[:n] = ZERO, ZERO
    for i in range(count):
        for j in range(count):
            if i != j:
                out[i * n + j] = -math.exp(lengths[i, j] - logs[i] - logs[j])
