"""Chebyshev descriptors of regions of Gaussians (Eqs 4-6).

Two backends agree to float32: `numba` is compiled, `reference` (torch) differentiable. Torch is
imported where it is needed only: finished scenes are described without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from chebsplat.kernels.threads import in_parts
from chebsplat.settings import DescribeSection
from chebsplat.shape import descriptor_kernel
from chebsplat.shape.described import Described, Descriptor
from chebsplat.splats.rotations import rotation_matrices_f64

if TYPE_CHECKING:
    import torch
    from torch import Tensor

DEFAULT = Descriptor()


def describe(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    parameters: Descriptor = DEFAULT,
    *,
    dtype: torch.dtype | None = None,
    backend: Literal["auto", "numba", "reference"] = "auto",
) -> Described[Tensor]:
    """Descriptor g^d(i) = n ([T_d(−S)]_ii − T_d(0)) of every Gaussian of every region, by angle,
    degree.

    Args:
      means, scales, rotmats, mask: [M, n, ...], as `albo.canonicalize`.
      dtype:   of the result, float32 if None; float64 by the reference only.
      backend: `numba` (float32, no gradient; the same bits for any number of threads), `reference`,
        or `auto`: numba where it can.
    Returns: values [M, n, J, P], zero where padded and in regions of fewer than two Gaussians,
      which have no edge. Of the full spectrum it is the printed formula with K = n and λ_max = 2,
      without degrees 0 and 1, which vanish.
    Raises: ValueError on sizes or parameters that make no sense, or that the backend does not take.
    """
    import torch

    w = parameters
    if w.n_angles < 1 or w.max_degree < 2 or not w.bandwidth > 0 or not w.anisotropy >= 0:
        raise ValueError(
            "n_angles >= 1, max_degree >= 2, bandwidth > 0 and anisotropy >= 0 are needed"
        )
    if (
        means.shape != scales.shape
        or rotmats.shape != (*means.shape, 3)
        or mask.shape != means.shape[:2]
    ):
        raise ValueError(
            f"shapes disagree: {means.shape}, {scales.shape}, {rotmats.shape}, {mask.shape}"
        )
    regions, dtype = (means, scales, rotmats, mask), dtype or torch.float32
    differentiable = any(v.requires_grad for v in regions)
    can_compile = dtype == torch.float32 and not differentiable
    if backend == "reference" or (backend == "auto" and not can_compile):
        from chebsplat.shape import descriptor_reference

        return Described(descriptor_reference.describe(*regions, parameters, dtype=dtype))
    if backend not in ("auto", "numba"):
        raise ValueError(f"backend {backend!r} is none of auto, numba, reference")
    if not can_compile:
        raise ValueError("the numba backend takes float32 only, and no gradients")
    sizes = w.n_angles, w.max_degree, w.anisotropy, w.bandwidth
    values, n_exact = _compiled(
        means.numpy(), scales.numpy(), rotmats.numpy(), mask.numpy(), *sizes
    )
    return Described(torch.from_numpy(values), n_exact)


def describe_members(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    members: np.ndarray,
    settings: DescribeSection,
    *,
    chunk: int = 2048,
) -> Described[np.ndarray]:
    """Descriptors f32 [M, n, J, P] of regions of Gaussians given by their members; without torch.

    Args:
      means:   [N, 3] scene units; quats [N, 4] wxyz, of any length; scales [N, 3] standard
        deviations, scene units.
      members: i64 [M, n], -1 where padded.
      chunk:   regions at a time, at most: bounds memory.
    """
    sizes = settings.n_angles, settings.max_degree, settings.anisotropy, settings.bandwidth
    values, n_exact = (
        np.zeros((*members.shape, settings.n_angles, settings.max_degree - 1), np.float32),
        0,
    )
    for start in range(0, len(members), chunk):
        part = members[start : start + chunk]
        index = np.maximum(part, 0)
        rotmats = rotation_matrices_f64(quats[index])
        values[start : start + chunk], exact = _compiled(
            means[index], scales[index], rotmats, part >= 0, *sizes
        )
        n_exact += exact
    return Described(values, n_exact)


def _compiled(
    means: np.ndarray,
    scales: np.ndarray,
    rotmats: np.ndarray,
    mask: np.ndarray,
    n_angles: int,
    max_degree: int,
    anisotropy: float,
    bandwidth: float,
) -> tuple[np.ndarray, int]:
    """The kernel's values f32 [M, n, J, D - 1], and how many regions took the float64 operator."""
    out = np.zeros((*mask.shape, n_angles, max_degree - 1), np.float32)
    exact = np.zeros(len(mask), np.bool_)
    parts = [np.ascontiguousarray(v, np.float64) for v in (means, scales, rotmats)]
    in_parts(descriptor_kernel.describe, len(mask), *parts, np.ascontiguousarray(mask),
             float(anisotropy), float(bandwidth), out, exact)  # fmt: skip
    return out, int(exact.sum())
