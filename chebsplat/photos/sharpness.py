"""Sharpness of photos: which of a capture's are blurred."""

from __future__ import annotations

import numpy as np

WEAK = 0.5  # of the median variance: less detail than half of the views have
SOFT = 0.6  # of the median ratio of fine to coarse detail


def laplacian_variance(grey: np.ndarray) -> float:
    """Variance of the 4-neighbour Laplacian of an image [H, W], inside its borders (Pech-Pacheco et al. 2000).

    Returns: 0.0 of an image under 3 pixels a side.
    """
    if min(grey.shape) < 3:
        return 0.0
    values = grey.astype(np.float32, copy=False)
    inside = values[1:-1, 1:-1]
    beside = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return float((beside - 4 * inside).var(dtype=np.float64))


def detail(grey: np.ndarray) -> tuple[float, float]:
    """(variance of the Laplacian at full resolution, at a quarter of it) of an image [H, W]."""
    height, width = (side // 4 * 4 for side in grey.shape)
    coarse = grey[:height, :width].reshape(height // 4, 4, width // 4, 4).mean((1, 3), dtype=np.float32)
    return laplacian_variance(grey), laplacian_variance(coarse)


def blurred(details: np.ndarray) -> np.ndarray:
    """Which views are far less sharp than their capture's median, bool [V], of `detail` [V, 2].

    Choices: two signs must agree. A plain wall has little detail at either scale, and a carpet more at the fine one;
      blur takes the fine detail and leaves the coarse. Both are ratios to the medians, so that neither the images'
      size nor their contrast matters, and a capture that is blurred throughout has no blurred view.
    """
    fine, coarse = details.T
    softness = fine / np.maximum(coarse, 1e-9)
    return np.asarray((fine < WEAK * np.median(fine)) & (softness < SOFT * np.median(softness)))
