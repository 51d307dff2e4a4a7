"""The full-spectrum descriptor of numpy arrays: the one door to its compiled kernel, for torch's callers and for those
that have no torch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class DescribedArrays(NamedTuple):
    """values f32 [M, n, J, D - 1], zero where padded; n_exact regions took the float64 operator."""

    values: np.ndarray
    n_exact: int


def describe_regions(
    means: np.ndarray,
    scales: np.ndarray,
    rotmats: np.ndarray,
    mask: np.ndarray,
    *,
    n_angles: int = 8,
    max_degree: int = 8,
    anisotropy: float = 10.0,
    bandwidth: float = 0.7,
) -> DescribedArrays:
    """Descriptors of regions [M, n], as `descriptor.describe_reference` documents: float64 up to the operator, then
    float32. The same bits for any number of threads. Padding costs nothing.

    Raises: ValueError on sizes or parameters that make no sense.
    """
    from chebsplat.shape.descriptor_kernel import describe

    check(means, scales, rotmats, mask, n_angles, max_degree, anisotropy, bandwidth)
    out = np.zeros((*mask.shape, n_angles, max_degree - 1), np.float32)
    exact = np.zeros(len(mask), np.bool_)
    parts = [np.ascontiguousarray(v, np.float64) for v in (means, scales, rotmats)]
    describe(*parts, np.ascontiguousarray(mask), float(anisotropy), float(bandwidth), out, exact)
    return DescribedArrays(out, int(exact.sum()))


def describe_members(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    members: np.ndarray,
    *,
    n_angles: int,
    max_degree: int,
    anisotropy: float,
    bandwidth: float,
    chunk: int = 2048,
) -> DescribedArrays:
    """Descriptors of Gaussians [N] gathered by `members` i64 [M, n], -1 where padded; `chunk` bounds memory."""
    values = np.zeros((*members.shape, n_angles, max_degree - 1), np.float32)
    sizes: dict[str, Any] = {"n_angles": n_angles, "max_degree": max_degree}
    sizes |= {"anisotropy": anisotropy, "bandwidth": bandwidth}
    n_exact = 0
    for start in range(0, len(members), chunk):
        part = members[start : start + chunk]
        index = np.maximum(part, 0)
        found = describe_regions(means[index], scales[index], frames(quats[index]), part >= 0, **sizes)
        values[start : start + chunk] = found.values
        n_exact += found.n_exact
    return DescribedArrays(values, n_exact)


def frames(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] f64 of quaternions [..., 4], wxyz, of any length; identity for a zero one.

    Choices: pre-scaled by the largest entry, so that neither 1e20 nor 1e-20 overflows or vanishes.
    """
    q = np.asarray(quats, np.float64)
    q = q / np.abs(q).max(-1, keepdims=True).clip(1e-30)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True).clip(1e-12), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def check(
    means: Any,
    scales: Any,
    rotmats: Any,
    mask: Any,
    n_angles: int,
    max_degree: int,
    anisotropy: float,
    bandwidth: float,
    n_eigs: int = 1,
) -> None:
    """Raises: ValueError on shapes (of arrays or tensors) or parameters that make no sense."""
    if n_angles < 1 or max_degree < 2 or n_eigs < 1 or not bandwidth > 0 or not anisotropy >= 0:
        raise ValueError("n_angles >= 1, max_degree >= 2, n_eigs >= 1, bandwidth > 0 and anisotropy >= 0 are needed")
    if means.shape != scales.shape or rotmats.shape != (*means.shape, 3) or mask.shape != means.shape[:2]:
        raise ValueError(f"shapes disagree: {means.shape}, {scales.shape}, {rotmats.shape}, {mask.shape}")
