"""Chebyshev descriptors of regions of Gaussians (Eqs 4-6).

Two backends agree to float32: `numba` compiles the full spectrum, `reference` (torch) differentiates it, and knows
cut spectra and the printed metric and axis. Torch is imported where it is needed only: finished scenes are described
without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from chebsplat.settings import DescribeSection
from chebsplat.shape import descriptor_kernel
from chebsplat.shape.described import Described, Descriptor, compiles, n_degrees
from chebsplat.splats.rotations import rotation_matrices, rotation_matrices_f64

if TYPE_CHECKING:
    import torch
    from torch import Tensor

DEFAULT = Descriptor()
OF_REGIONS = {"n_regions", "region_size", "seed", "region_radius", "overlap", "thinning"}  # not of values


def describe(
    means: Tensor,
    scales: Tensor,
    rotmats: Tensor,
    mask: Tensor,
    wanted: Descriptor = DEFAULT,
    *,
    dtype: torch.dtype | None = None,
    backend: Literal["auto", "numba", "reference"] = "auto",
) -> Described[Tensor]:
    """Descriptor of every Gaussian of every region: g^d(i) = n ([T_d(−S)]_ii − T_d(0)), by angle and degree.

    Args:
      means, scales, rotmats, mask: [M, n, ...], as `albo.canonicalize`.
      dtype:   of the result, float32 if None; float64 by the reference only.
      backend: `numba` (what `compiles`, float32, no gradient; the same bits for any number of threads), `reference`, or
        `auto`: numba where it can.
    Returns: values [M, n, J, P], zero where padded and in regions of fewer than two Gaussians, which have no edge. Of
      the full spectrum it is the printed formula with K = n and λ_max = 2, without degrees 0 and 1, which vanish.
    Raises: ValueError on sizes or parameters that make no sense, or that the backend does not take.
    """
    import torch

    w = wanted
    if w.n_angles < 1 or w.max_degree < 2 or w.n_eigs < 1 or not w.bandwidth > 0 or not w.anisotropy >= 0:
        raise ValueError("n_angles >= 1, max_degree >= 2, n_eigs >= 1, bandwidth > 0 and anisotropy >= 0 are needed")
    if means.shape != scales.shape or rotmats.shape != (*means.shape, 3) or mask.shape != means.shape[:2]:
        raise ValueError(f"shapes disagree: {means.shape}, {scales.shape}, {rotmats.shape}, {mask.shape}")
    regions, dtype = (means, scales, rotmats, mask), dtype or torch.float32
    differentiable = any(v.requires_grad for v in regions)
    can_compile = compiles(w.spectrum, w.metric, w.axis) and dtype == torch.float32 and not differentiable
    if backend == "reference" or (backend == "auto" and not can_compile):
        from chebsplat.shape import descriptor_reference

        found = descriptor_reference.describe(*regions, wanted, dtype=dtype)
    elif backend not in ("auto", "numba"):
        raise ValueError(f"backend {backend!r} is none of auto, numba, reference")
    elif not can_compile:
        raise ValueError(
            "the numba backend takes no cut spectrum, printed metric or axis, only float32 and no gradients"
        )
    else:
        sizes = w.n_angles, w.max_degree, w.anisotropy, w.bandwidth
        values, n_exact = _compiled(means.numpy(), scales.numpy(), rotmats.numpy(), mask.numpy(), *sizes)
        found = Described(torch.from_numpy(values), n_exact=n_exact)
    n = n_degrees(w.spectrum, w.max_degree, w.from_degree)  # what is missing in front vanishes identically
    return found._replace(values=torch.nn.functional.pad(found.values, (n - found.values.shape[-1], 0)))


def describe_members(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    members: np.ndarray,
    settings: DescribeSection,
    *,
    chunk: int = 2048,
) -> Described[np.ndarray]:
    """Descriptors f32 [M, n, J, P] of regions whose members are gathered from Gaussians; torch only if cut or printed.

    Args:
      means:   [N, 3] scene units; quats [N, 4] wxyz, of any length; scales [N, 3] standard deviations, scene units.
      members: i64 [M, n], -1 where padded.
      chunk:   regions at a time, at most: bounds memory.
    """
    full = compiles(settings.spectrum, settings.metric, settings.axis)
    n = n_degrees(settings.spectrum, settings.max_degree, settings.from_degree)
    values, counts = np.zeros((*members.shape, settings.n_angles, n), np.float32), np.zeros(4, np.int64)
    step = chunk if full else min(chunk, 256)
    for start in range(0, len(members), step):
        part = members[start : start + step]
        index = np.maximum(part, 0)
        described = (_full if full else _reference)(means[index], quats[index], scales[index], part >= 0, settings)
        values[start : start + step, ..., n - described.values.shape[-1] :] = described.values
        counts += described[1:]
    return Described(values, *counts.tolist())


def _full(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, mask: np.ndarray, settings: DescribeSection
) -> Described[np.ndarray]:
    sizes = settings.n_angles, settings.max_degree, settings.anisotropy, settings.bandwidth
    values, n_exact = _compiled(means, scales, rotation_matrices_f64(quats), mask, *sizes)
    return Described(values, n_exact=n_exact)


def _reference(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, mask: np.ndarray, settings: DescribeSection
) -> Described[np.ndarray]:
    import torch

    rotmats = rotation_matrices(torch.from_numpy(quats).reshape(-1, 4)).reshape(*mask.shape, 3, 3)
    regions = torch.from_numpy(means), torch.from_numpy(scales), rotmats, torch.from_numpy(mask)
    parameters = settings.model_dump(exclude=OF_REGIONS)
    described = describe(*regions, Descriptor(**parameters), dtype=torch.float64, backend="reference")
    return Described(described.values.float().numpy(), *described[1:])


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
    descriptor_kernel.describe(*parts, np.ascontiguousarray(mask), float(anisotropy), float(bandwidth), out, exact)
    return out, int(exact.sum())
