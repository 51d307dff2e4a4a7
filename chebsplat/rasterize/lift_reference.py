"""The lift of one view, transcribed in float64 without tiles or bounds: the oracle of `lift`."""

from __future__ import annotations

import numpy as np
import torch

from chebsplat.rasterize import CELL
from chebsplat.rasterize.projection import project
from chebsplat.rasterize.reference import ALPHA_MIN, T_MIN


def pixel_weights(
    gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    max_alpha: float = 0.99,
) -> np.ndarray:
    """Weights w = α T of every Gaussian at every pixel, f64 [H, W, N]; arguments as of `lift.lift`."""
    means, quats, scales, opacities = (torch.from_numpy(np.asarray(a, np.float64)) for a in gaussians)
    width, height = size
    pose, intrinsics = (torch.from_numpy(np.asarray(matrix, np.float64)) for matrix in (viewmat, K))
    view = project(means, quats, scales, pose, intrinsics, width, height, 0.01, 1e10, 0.3)
    order = torch.argsort(view.depths, stable=True).numpy()
    whitening, centers = view.whitening.numpy(), view.means2d.numpy()
    opacity = np.where(view.visible.numpy() & (opacities.numpy() >= ALPHA_MIN), opacities.numpy(), 0.0)
    y, x = np.indices((height, width)) + 0.5
    weights, transmittance = np.zeros((height, width, len(means))), np.ones((height, width))
    is_open = np.ones((height, width), bool)
    for i in order:
        (p, q, r), dx, dy = whitening[i], x - centers[i, 0], y - centers[i, 1]
        alpha = opacity[i] * np.exp(-((p * dx + q * dy) ** 2) - (r * dy) ** 2)
        alpha = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, max_alpha), 0.0)
        after = transmittance * (1 - alpha)
        is_open &= after > T_MIN
        weights[..., i] = np.where(is_open, alpha * transmittance, 0.0)
        transmittance = np.where(is_open, after, transmittance)
    return weights


def lift(
    gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    values: np.ndarray,
    counts: np.ndarray,
    gate: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights f64 [N] and sums f64 [N, C] of all Gaussians; arguments as of `lift.lift`."""
    weights = pixel_weights(gaussians, viewmat, K, size)
    weights[weights < gate * weights.max(-1, keepdims=True, initial=0)] = 0
    down, right = (-weights.shape[0] % CELL, -weights.shape[1] % CELL)
    whole = np.pad(weights, ((0, down), (0, right), (0, 0)))
    by_cell = whole.reshape(counts.shape[0], CELL, counts.shape[1], CELL, -1).sum((1, 3))
    by_cell = by_cell * counts.astype(np.float64)[..., None]
    finite = np.where(counts[..., None] > 0, values, 0).astype(np.float64)
    return by_cell.sum((0, 1)), np.einsum("yxn,yxc->nc", by_cell, finite)
