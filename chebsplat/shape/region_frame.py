"""One region in canonical units, its metric and its axis, in compiled float64: the twin of the
torch functions in `albo`, which say why each step is as it is.

Members that are masked or not finite are dropped here, so that what follows sees no padding.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import serial


@serial
def canonical(means, scales, rotmats, mask, index, points, sizes, frames):
    """Canonical members in front: `index` their rows, points and sizes [count, 3], frames [count,
    3, 3].

    Args: means, scales [n, 3], rotmats [n, 3, 3], mask [n]; the others are filled.
    Returns: count.
    """
    count = 0
    for i in range(len(mask)):
        size = 0.0
        for k in range(3):
            size += abs(means[i, k]) * 0.0 + abs(scales[i, k]) * 0.0
            for j in range(3):
                size += abs(rotmats[i, k, j]) * 0.0
        if mask[i] and size == 0.0:  # 0 · inf and 0 · nan are nan
            index[count] = i
            for k in range(3):
                points[count, k], sizes[count, k] = means[i, k], scales[i, k]
                for j in range(3):
                    frames[count, k, j] = rotmats[i, k, j]
            count += 1
    if count == 0:
        return 0
    extent = radius = 0.0
    for k in range(3):
        first = points[0, k]
        for i in range(count):
            points[i, k] -= first
            extent = max(extent, abs(points[i, k]))
    extent = extent if extent > 0.0 else 1.0
    for k in range(3):
        mean = 0.0
        for i in range(count):
            points[i, k] /= extent
            mean += points[i, k]
        mean /= count
        for i in range(count):
            points[i, k] -= mean
            radius += points[i, k] * points[i, k]
    radius = math.sqrt(radius / count)
    radius = radius if radius > 0.0 else 1.0
    for i in range(count):
        for k in range(3):
            points[i, k] /= radius
            sizes[i, k] = sizes[i, k] / extent / radius
    return count


@serial
def lower_median(values, count):
    """Lower median of values[:count], by ranks: `numpy.sort` takes a second to compile."""
    middle = (count - 1) // 2
    for i in range(count):
        rank = 0
        for j in range(count):
            if values[j] < values[i] or (values[j] == values[i] and j < i):
                rank += 1
        if rank == middle:
            return values[i]
    return 0.0


@serial
def metric(sizes, frames, count, anisotropy, largest, factors):
    """Y_i = diag(sqrt(m_i)) R_iᵀ of each member into factors [count, 3, 3]; `largest`: scratch."""
    for i in range(count):
        largest[i] = max(sizes[i, 0], sizes[i, 1], sizes[i, 2])
    typical = lower_median(largest, count)
    root = math.sqrt(anisotropy)
    for i in range(count):
        for k in range(3):
            ratio = 1e150 if sizes[i, k] > 0.0 else 0.0
            if typical > 0.0:
                ratio = sizes[i, k] / typical
            length = 1.0 / math.hypot(1.0, root * ratio)
            for j in range(3):
                factors[i, k, j] = length * frames[i, j, k]


@serial
def eigen(a, vectors):
    """Eigenvalues of a symmetric a [3, 3] onto its diagonal, eigenvectors into columns (Jacobi)."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):  # converges quadratically: 6 sweeps reach round-off
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        if off == 0.0:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                slope = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = (1.0 if slope >= 0.0 else -1.0) / (abs(slope) + math.hypot(slope, 1.0))
                c = 1.0 / math.hypot(t, 1.0)
                s = t * c
                for k in range(3):
                    u, v = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * u - s * v, s * u + c * v
                for k in range(3):
                    u, v = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * u - s * v, s * u + c * v
                a[p, q] = a[q, p] = 0.0
                for k in range(3):
                    u, v = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * u - s * v, s * u + c * v


@serial
def tangent_axis(points, sizes, frames, count, axis):
    """Least-variance axis of the region's mixture into `axis` [3]; returns its certainty."""
    widest = 1.0
    for i in range(count):
        widest = max(widest, sizes[i, 0], sizes[i, 1], sizes[i, 2])
    mixture, vectors = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(count):
        for u in range(3):
            for v in range(u, 3):
                term = (points[i, u] / widest) * (points[i, v] / widest)
                for k in range(3):
                    s = sizes[i, k] / widest
                    term += (frames[i, u, k] * s) * (frames[i, v, k] * s)
                mixture[u, v] += term
    for u in range(3):
        for v in range(u, 3):
            mixture[u, v] /= count
            mixture[v, u] = mixture[u, v]
    eigen(mixture, vectors)
    lowest = 0
    for k in range(1, 3):
        if mixture[k, k] < mixture[lowest, lowest]:
            lowest = k
    p, q = mixture[(lowest + 1) % 3, (lowest + 1) % 3], mixture[(lowest + 2) % 3, (lowest + 2) % 3]
    low, middle, high = max(mixture[lowest, lowest], 0.0), max(min(p, q), 0.0), max(p, q, 0.0)
    for k in range(3):
        axis[k] = vectors[k, lowest]
    scale = low + middle + 1e-5 * high
    gap = (middle - low) / scale if scale > 0.0 else 0.0
    t = min(max((gap - 0.02) / 0.08, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@serial
def turn_back(points, count, axis, angle, turned):
    """Rotᵀ c of each point, Rot by `angle` about `axis`: as if Rot turned every metric."""
    sin, cos = math.sin(-angle), 1.0 - math.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    for i in range(count):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        turned[i, 0] = a + sin * u + cos * (y * w - z * v)
        turned[i, 1] = b + sin * v + cos * (z * u - x * w)
        turned[i, 2] = c + sin * w + cos * (x * v - y * u)
