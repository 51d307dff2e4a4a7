"""Numba twin of `projection.project` for one view, and its adjoint: parallel, float64 inside.

Beside mean and covariance each Gaussian gets its whitening W = [[p, q], [0, r]], WᵀW = ½ log₂e Σ⁻¹,
so that at an offset d from the mean log₂ α = log₂ opacity − |W d|². W comes from the determinant by
Cauchy-Binet, which cannot cancel, and gradients are gathered in W d: a needle's are as exact as a
ball's.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import body, kernel
from chebsplat.kernels.threads import in_parts

HALF_LOG2E = 0.5 * math.log2(math.e)
LN2 = math.log(2.0)
# as `projection`'s, which numba's cache could not follow
LARGEST, EXTENT, LEAST_KEPT = 1e30, 3.33, 0.005


@body
def _matmul(a, b, out, rows, inner, columns):
    """The sizes, as literals, let the compiler unroll."""
    for i in range(rows):
        for j in range(columns):
            total = 0.0
            for k in range(inner):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@body
def _rotation(quat, unit, out):
    """Fill the unit quaternion [4] and its matrix [3, 3]; returns the length of `quat`."""
    largest = max(max(abs(quat[0]), abs(quat[1])), max(abs(quat[2]), abs(quat[3])))
    total, shrink = 0.0, 1.0 / largest
    for k in range(4):
        unit[k] = quat[k] * shrink
        total += unit[k] * unit[k]
    root = math.sqrt(total)
    shrink = 1.0 / root
    for k in range(4):
        unit[k] *= shrink
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return largest * root


@body
def _clamped(slope, center, focal, size):
    """The ray's slope, kept within 1.3 fields of view."""
    slack = 0.15 * size / focal
    return min(max(slope, -(center / focal + slack)), (size - center) / focal + slack)


@body
def _jacobian(point, viewmat, K, width, height, out, jacobian):
    """Fill `out` [3], the camera-space point, and `jacobian` [2, 3] of the pixel, clamped."""
    for i in range(3):
        out[i] = viewmat[i, 3]
        for k in range(3):
            out[i] += viewmat[i, k] * point[k]
    near = 1.0 / out[2]
    jacobian[0, 0], jacobian[0, 1] = K[0, 0] * near, 0.0
    jacobian[1, 0], jacobian[1, 1] = 0.0, K[1, 1] * near
    jacobian[0, 2] = -K[0, 0] * near * _clamped(out[0] * near, K[0, 2], K[0, 0], width)
    jacobian[1, 2] = -K[1, 1] * near * _clamped(out[1] * near, K[1, 2], K[1, 1], height)


@body
def _squared(jacobian):
    """Sum of squares of a [2, 3]."""
    total = 0.0
    for i in range(2):
        for k in range(3):
            total += jacobian[i, k] * jacobian[i, k]
    return total


@body
def _cross(a, b, out):
    out[0], out[1], out[2] = (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@body
def _ellipse(factor, eps2d, cross):
    """F Fᵀ + ε I: xx, xy, yy, determinant by Cauchy-Binet, |f × g|; fills `cross` with f × g."""
    a = b = c = 0.0
    for k in range(3):
        a += factor[0, k] * factor[0, k]
        b += factor[0, k] * factor[1, k]
        c += factor[1, k] * factor[1, k]
    _cross(factor[0], factor[1], cross)
    area = cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]
    determinant = eps2d * eps2d + eps2d * (a + c) + area
    return a + eps2d, b, c + eps2d, determinant, math.sqrt(area)


@kernel
def _project(
    first, last, means, quats, scales, viewmat, turn, K, width, height, near_plane, far_plane,
    eps2d, means2d, covariances, whitening, conics, depths, radii, compensations,
):  # fmt: skip
    """`project` of the Gaussians from `first` up to `last`, into what it returns."""
    unit, camera, cross = np.empty(4), np.empty(3), np.empty(3)
    rotation, jacobian, screen, factor = (
        np.empty((3, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
    )
    for i in range(first, last):
        depth = viewmat[2, 3]
        for k in range(3):
            depth += viewmat[2, k] * means[i, k]
        if not (depth > near_plane and depth < far_plane):
            continue
        _jacobian(means[i], viewmat, K, width, height, camera, jacobian)
        u, v = jacobian[0, 0] * camera[0] + K[0, 2], jacobian[1, 1] * camera[1] + K[1, 2]
        size = max(max(abs(scales[i, 0]), abs(scales[i, 1])), abs(scales[i, 2]))
        # at least the covariance's largest eigenvalue, without ε
        steepest = size * size * _squared(jacobian)
        farthest = EXTENT * math.sqrt(steepest + eps2d) + 2  # at least `reach` below
        if u + farthest < 0 or u - farthest > width or v + farthest < 0 or v - farthest > height:
            continue
        largest = max(
            max(abs(quats[i, 0]), abs(quats[i, 1])), max(abs(quats[i, 2]), abs(quats[i, 3]))
        )
        sums = 1.0 * quats[i, 0] + quats[i, 1] + quats[i, 2] + quats[i, 3]
        if not (largest > 1e-12 and math.isfinite(largest) and math.isfinite(sums - sums)):
            continue
        _rotation(quats[i], unit, rotation)
        _matmul(jacobian, turn, screen, 2, 3, 3)
        _matmul(screen, rotation, factor, 2, 3, 3)
        for k in range(3):
            factor[0, k] *= scales[i, k]
            factor[1, k] *= scales[i, k]
        a, b, c, determinant, area = _ellipse(factor, eps2d, cross)
        biggest = 0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b)
        if not (determinant > 0 and determinant < LARGEST * LARGEST and biggest < LARGEST):
            continue
        reach = min(math.ceil(EXTENT * math.sqrt(biggest)), 2.0**30)
        if not (u + reach > 0 and u - reach < width and v + reach > 0 and v - reach < height):
            continue
        means2d[i, 0], means2d[i, 1], depths[i], radii[i] = u, v, depth, int(reach)
        covariances[i, 0], covariances[i, 1], covariances[i, 2] = a, b, c
        over = 1.0 / determinant
        conics[i, 0], conics[i, 1], conics[i, 2] = c * over, -b * over, a * over
        compensations[i] = max(area * math.sqrt(over), LEAST_KEPT)
        p, under = math.sqrt(HALF_LOG2E * c * over), 1.0 / c
        whitening[i, 0], whitening[i, 1], whitening[i, 2] = (
            p,
            -p * b * under,
            math.sqrt(HALF_LOG2E * under),
        )


def project(
    means, quats, scales, viewmat, K, width, height, near_plane, far_plane, eps2d,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Ellipses of one view.

    Args: means, scales [N, 3], quats [N, 4] float32; viewmat [4, 4], K [3, 3] float64.
    Returns: float32 means2d [N, 2], covariances [N, 3] (xx, xy, yy; ε included), whitening [N, 3]
      (p, q, r), conics [N, 3], depths [N]; radii [N] i32; compensations [N] f32, √(det Σ / det(Σ +
      ε I)), at least LEAST_KEPT. Rows of culled Gaussians are zero; a visible one's radius is not.
    """
    n = len(means)
    widths = 2, 3, 3, 3  # of means2d, covariances, whitening, conics
    out = (
        *(np.zeros((n, columns), np.float32) for columns in widths),
        *(np.zeros(n, kind) for kind in (np.float32, np.int32, np.float32)),
    )
    turn = np.ascontiguousarray(viewmat[:3, :3])
    in_parts(_project, n, means, quats, scales, viewmat, turn, K, width, height, near_plane,
             far_plane, eps2d, *out)  # fmt: skip
    return out


@body
def _rotation_adjoint(unit, length, by, out):
    """Gradient [4] to a quaternion of this length from that to its matrix [3, 3]."""
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    skew_x, skew_y, skew_z = by[2, 1] - by[1, 2], by[0, 2] - by[2, 0], by[1, 0] - by[0, 1]
    out[0] = 2 * (x * skew_x + y * skew_y + z * skew_z)
    out[1] = 2 * (
        w * skew_x
        + y * (by[0, 1] + by[1, 0])
        + z * (by[0, 2] + by[2, 0])
        - 2 * x * (by[1, 1] + by[2, 2])
    )
    out[2] = 2 * (
        w * skew_y
        + x * (by[0, 1] + by[1, 0])
        + z * (by[1, 2] + by[2, 1])
        - 2 * y * (by[0, 0] + by[2, 2])
    )
    out[3] = 2 * (
        w * skew_z
        + x * (by[0, 2] + by[2, 0])
        + y * (by[1, 2] + by[2, 1])
        - 2 * z * (by[0, 0] + by[1, 1])
    )
    along = out[0] * w + out[1] * x + out[2] * y + out[3] * z
    shrink = 1.0 / length
    for k in range(4):
        out[k] = (out[k] - along * unit[k]) * shrink


@kernel
def _project_adjoint(
    first, last, means, quats, scales, viewmat, turn, K, width, height, eps2d, radii,
    grad_means2d, moments, grad_compensations, to_means, to_quats, to_scales,
):  # fmt: skip
    """`project_adjoint` of the Gaussians from `first` up to `last`, into what it returns.

    The gradient to the factor F of Σ is 2 / (½ log₂e) Wᵀ M (W F): W F is bounded, while gradients
    to Σ itself would have to cancel over the needle's length. The compensation is |f × g| / √det of
    F's rows f and g; its gradient is taken at the unit normal f × g / |f × g|, which stays bounded
    as the ellipse flattens, and is 0 below its floor.
    """
    unit, camera, normal, across = np.empty(4), np.empty(3), np.empty(3), np.empty((2, 3))
    rotation, jacobian, screen = np.empty((3, 3)), np.empty((2, 3)), np.empty((2, 3))
    axes, factor = np.empty((2, 3)), np.empty((2, 3))
    by_axes, by_screen, by_rotation = np.empty((2, 3)), np.empty((2, 3)), np.empty((3, 3))
    by_jacobian, by_scales, by_quat = np.empty((2, 3)), np.empty(3), np.empty(4)
    for i in range(first, last):
        if radii[i] == 0:
            continue
        length = _rotation(quats[i], unit, rotation)
        _jacobian(means[i], viewmat, K, width, height, camera, jacobian)
        _matmul(jacobian, turn, screen, 2, 3, 3)
        _matmul(screen, rotation, axes, 2, 3, 3)
        # F = A S, A = P R, P = J V: down to A, to the scales, and on to R and P.
        for k in range(3):
            factor[0, k], factor[1, k] = axes[0, k] * scales[i, k], axes[1, k] * scales[i, k]
        a, b, c, determinant, area = _ellipse(factor, eps2d, normal)
        under = 1.0 / c
        p, r = math.sqrt(HALF_LOG2E * c / determinant), math.sqrt(HALF_LOG2E * under)
        q = -p * b * under
        uu, uv, vv = (
            2 / HALF_LOG2E * moments[i, 0],
            2 / HALF_LOG2E * moments[i, 1],
            2 / HALF_LOG2E * moments[i, 2],
        )
        for k in range(3):
            s = 1.0 * scales[i, k]
            axis_u, axis_v = p * axes[0, k] + q * axes[1, k], r * axes[1, k]
            top, low = s * (uu * axis_u + uv * axis_v), s * (uv * axis_u + vv * axis_v)
            by_scales[k] = top * axis_u + low * axis_v
            by_axes[0, k], by_axes[1, k] = s * p * top, s * (q * top + r * low)
        if grad_compensations[i] != 0 and area > LEAST_KEPT * math.sqrt(determinant):
            weight = grad_compensations[i] / (determinant * math.sqrt(determinant))
            for k in range(3):
                normal[k] /= area
            _cross(factor[1], normal, across[0])
            _cross(normal, factor[0], across[1])
            spread = eps2d * (a + c - eps2d)  # det − |f × g|²; a and c have ε inside
            for k in range(3):
                top = weight * (spread * across[0, k] - eps2d * area * factor[0, k])
                low = weight * (spread * across[1, k] - eps2d * area * factor[1, k])
                by_scales[k] += top * axes[0, k] + low * axes[1, k]
                by_axes[0, k] += top * scales[i, k]
                by_axes[1, k] += low * scales[i, k]
        _matmul(by_axes, rotation.T, by_screen, 2, 3, 3)
        _matmul(screen.T, by_axes, by_rotation, 3, 2, 3)
        _matmul(by_screen, turn.T, by_jacobian, 2, 3, 3)
        x, y, near, fx, fy = camera[0], camera[1], 1.0 / camera[2], K[0, 0], K[1, 1]
        slope_x, slope_y = (
            _clamped(x * near, K[0, 2], fx, width),
            _clamped(y * near, K[1, 2], fy, height),
        )
        by_x, by_y = fx * near * grad_means2d[i, 0], fy * near * grad_means2d[i, 1]
        by_z = -(by_x * x + by_y * y) * near
        steep_x, steep_y = fx * near * near, fy * near * near
        by_z += steep_x * (slope_x * by_jacobian[0, 2] - by_jacobian[0, 0])
        by_z += steep_y * (slope_y * by_jacobian[1, 2] - by_jacobian[1, 1])
        if slope_x == x * near:
            by_x -= steep_x * by_jacobian[0, 2]
            by_z += steep_x * slope_x * by_jacobian[0, 2]
        if slope_y == y * near:
            by_y -= steep_y * by_jacobian[1, 2]
            by_z += steep_y * slope_y * by_jacobian[1, 2]
        for k in range(3):
            to_means[i, k] = viewmat[0, k] * by_x + viewmat[1, k] * by_y + viewmat[2, k] * by_z
            to_scales[i, k] = by_scales[k]
        _rotation_adjoint(unit, length, by_rotation, by_quat)
        for k in range(4):
            to_quats[i, k] = by_quat[k]


def project_adjoint(
    means, quats, scales, viewmat, K, width, height, eps2d, radii, grad_means2d, moments,
    grad_compensations,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gradients [N, 3], [N, 4], [N, 3] to means, quats and scales; zero rows where culled.

    Args: grad_means2d [N, 2]; moments [N, 3]: uu, uv, vv of Σ g (W d)(W d)ᵀ over a Gaussian's
      pixels; grad_compensations [N].
    """
    n = len(means)
    to_means, to_scales = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    to_quats = np.zeros((n, 4), np.float32)
    turn = np.ascontiguousarray(viewmat[:3, :3])
    in_parts(_project_adjoint, n, means, quats, scales, viewmat, turn, K, width, height, eps2d,
             radii, grad_means2d, moments, grad_compensations, to_means, to_quats, to_scales,
    )  # fmt: skip
    return to_means, to_quats, to_scales
