"""Rotations of Gaussians, quaternions wxyz of any length: in torch, and in numpy for kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4]; identity for a zero one.

    Choices: pre-scaled by the largest entry, so that neither 1e20 nor 1e-20 overflows or vanishes.
    """
    import torch

    scaled = quats / quats.detach().abs().amax(-1, keepdim=True).clamp_min(1e-30)
    w, x, y, z = torch.nn.functional.normalize(scaled, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def rotation_matrices_f64(quats: np.ndarray) -> np.ndarray:
    """`rotation_matrices` in numpy, for kernels: f64 [..., 3, 3] of quaternions [..., 4]."""
    q = np.asarray(quats, np.float64)
    q = q / np.abs(q).max(-1, keepdims=True).clip(1e-30)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True).clip(1e-12), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
