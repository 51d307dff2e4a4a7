"""Gaussian parameters: from points with local shape to raw ones, from raw to activated values.

Rows chosen by an index have a cheap gradient.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from chebsplat.splats.rotations import rotation_matrices, rotation_matrices_f64

_C0 = 0.28209479177387814


def local_shape(
    means: np.ndarray, n_neighbors: int, floor: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Local covariances by PCA over neighbours (docs/method.md, section 1).

    Args:
      means:       [N, 3] scene units, N >= 2.
      n_neighbors: how many neighbours shape a point.
      floor:       least standard deviation, as a fraction of the spacing.
    Returns: covariances [N, 3, 3] and normals [N, 3] (unit, of arbitrary sign), float32.
    Choices: in-plane deviations follow the neighbourhood's but are scaled so that the larger one
      equals the spacing (rms distance of the three nearest); the normal one is the residual at that
      scale. Coincident points take the median spacing, so no scale is zero.
    """
    k = min(n_neighbors, len(means) - 1)
    distances, index = cKDTree(means).query(means, k + 1, workers=-1)
    spacing = np.sqrt((distances[:, 1:4] ** 2).mean(1))
    typical = np.median(spacing[spacing > 0]) if (spacing > 0).any() else 1.0
    spacing = np.clip(np.where(spacing > 0, spacing, typical), 1e-3 * typical, 1e3 * typical)
    offsets = means[index] - means[index].mean(1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", offsets, offsets) / (k + 1)
    values, axes = np.linalg.eigh(spread)
    deviations = np.sqrt(np.clip(values, 0, None))
    largest = deviations[:, 2:]
    relative = np.where(largest > 0, deviations / np.where(largest > 0, largest, 1), 1.0)
    scales = spacing[:, None] * np.clip(relative, floor, 1.0)
    covariances = np.einsum("nij,nj,nkj->nik", axes, scales**2, axes)
    return covariances.astype(np.float32), axes[:, :, 0].astype(np.float32)


def initial_gaussians(
    means: np.ndarray, colors: np.ndarray, covariances: np.ndarray, opacity: float = 0.1
) -> dict[str, Tensor]:
    """Raw parameters (float32) of Gaussians that start from points.

    Args: means [N, 3]; colors u8 [N, 3]; covariances [N, 3, 3] symmetric positive definite, scene
      units².
    Returns: `means`, `log_scales`, `quats` (wxyz, unit), `logit_opacities`, `sh0` [N,1,3].
    """
    values, axes = np.linalg.eigh(np.asarray(covariances, np.float64))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    quats = Rotation.from_matrix(axes).as_quat(scalar_first=True) if len(axes) else np.zeros((0, 4))
    log_scales = 0.5 * np.log(np.clip(values, 1e-14, None))
    n = len(means)
    raw = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats,
        "logit_opacities": np.full(n, np.log(opacity / (1 - opacity))),
        "sh0": sh0_of(colors),
    }
    return {
        name: torch.as_tensor(np.ascontiguousarray(value), dtype=torch.float32)
        for name, value in raw.items()
    }


def sh0_of(colors: np.ndarray) -> np.ndarray:
    """Coefficients f64 [N, 1, 3] of SH band 0 that show colours u8 [N, 3]."""
    return (colors[:, None].astype(np.float64) / 255 - 0.5) / _C0


def activated(raw: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """means [N, 3], quats [N, 4], scales [N, 3] > 0, opacities [N] in (0, 1) of raw parameters."""
    return raw["means"], raw["quats"], raw["log_scales"].exp(), raw["logit_opacities"].sigmoid()


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """R diag(s²) Rᵀ, [N, 3, 3]."""
    factor = rotation_matrices(quats) * scales[:, None, :]
    return factor @ factor.transpose(1, 2)


def surface_of(parameters: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Normals f32 [N, 3], unit, of any sign, and colours f32 [N, 3] in [0, 1], of raw parameters.

    Choices: the normal is the shortest axis, the first of equal ones; the colour that of SH degree
      0.
    """
    axes = rotation_matrices_f64(parameters["quats"])
    normals = axes[np.arange(len(axes)), :, parameters["log_scales"].argmin(1)]
    colors = np.clip(parameters["sh0"][:, 0] * _C0 + 0.5, 0, 1)
    return normals.astype(np.float32), colors.astype(np.float32)


class _Take(torch.autograd.Function):
    """Rows by an index without repeats: the gradient is one scatter, and accumulates nothing."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None


def take(values: Tensor, index: Tensor | None) -> Tensor:
    """values[index] for an index [V] that holds no row twice; None: all values."""
    if index is None:
        return values
    rows: Tensor = _Take.apply(values, index)
    return rows
