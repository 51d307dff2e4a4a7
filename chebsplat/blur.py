"""Separable blur of images by the window of SSIM, in numba."""

from __future__ import annotations

import numpy as np

from chebsplat.jit import kernel, prange

WINDOW, SIGMA = 11, 1.5
_x = np.arange(WINDOW) - WINDOW // 2
TAPS = (np.exp(-0.5 * (_x / SIGMA) ** 2) / np.exp(-0.5 * (_x / SIGMA) ** 2).sum()).astype(np.float32)


@kernel
def blur(images):
    """Blur [H, W, C] along rows and columns with zero padding; the operation is its own adjoint."""
    height, width, channels = images.shape
    half = WINDOW // 2
    flat = images.reshape(height, width * channels)
    rows = np.zeros((height, width * channels), np.float32)
    for y in prange(height):
        for t in range(WINDOW):
            shift = (t - half) * channels
            first, last = max(0, -shift), min(width * channels, width * channels - shift)
            tap = TAPS[t]
            for x in range(first, last):
                rows[y, x] += tap * flat[y, x + shift]
    out = np.zeros((height, width * channels), np.float32)
    for y in prange(height):
        for t in range(WINDOW):
            source = y + t - half
            if 0 <= source < height:
                tap = TAPS[t]
                for x in range(width * channels):
                    out[y, x] += tap * rows[source, x]
    return out.reshape(height, width, channels)
