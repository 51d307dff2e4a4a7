"""Light rounded to steps for small files, so that the cameras still see the colours they saw.

Cameras see a Gaussian from few sides, from which its coefficients look alike: what rounding takes
from one of them, the others can add.
"""

from __future__ import annotations

import numpy as np
import torch

from chebsplat.splats.sh import MAX_DEGREE, basis, n_coefficients

STEP = 6 / 128  # of a coefficient beyond band 0; 0.10 dB better than 4 / 128 without the others
ALONE = 4 / 128  # where there are no cameras to keep the colours for
EYES = 32  # that sides are taken of, at most
BLOCK = 8192  # Gaussians in memory at once


def rounded_light(parameters: dict[str, np.ndarray], eyes: np.ndarray) -> dict[str, np.ndarray]:
    """Raw parameters with `shN` in steps within ±1, and `sh0` that makes up for it.

    Args:    eyes: centres [V, 3] of the cameras; one alone, which a splat from elsewhere has, tells
      nothing.
    Choices: the highest coefficient is rounded first; what it loses goes to those below, by least
      squares over the sides that the eyes are on, and one from all around, which keeps other views
      near. Whether a camera looks there makes no difference. Bands of zero stay zero.
    """
    has_cameras = len(eyes) > 1
    step, eyes = (STEP, eyes) if has_cameras else (ALONE, eyes[:0])
    eyes = eyes[np.linspace(0, len(eyes) - 1, min(len(eyes), EYES)).astype(int)]
    light = np.concatenate([parameters["sh0"], parameters["shN"]], 1).astype(np.float64)
    lit = np.flatnonzero(light[:, 1:].any((1, 2)))
    for rows in np.array_split(lit, len(lit) // BLOCK + 1):
        part = light[rows]
        lower = np.linalg.cholesky(_sides(parameters["means"][rows].astype(np.float64), eyes))
        shares = -np.diagonal(lower, axis1=1, axis2=2)[..., None] * np.linalg.inv(lower)
        for k in range(part.shape[1] - 1, 0, -1):
            exact = part[:, k].copy()
            part[:, k] = step * np.rint(exact.clip(-1, 1) / step)
            part[:, :k] += shares[:, k, :k, None] * (exact - part[:, k])[:, None]
        light[rows] = part
    changed = {"sh0": light[:, :1], "shN": light[:, 1:]}
    return parameters | {name: values.astype(np.float32) for name, values in changed.items()}


def _sides(means: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Sums [N, K, K] of products of the basis over the sides of Gaussians that eyes [V, 3] see."""
    looks = means[:, None] - eyes
    looks /= np.linalg.norm(looks, axis=2, keepdims=True).clip(1e-300)
    values = basis(torch.from_numpy(looks.reshape(-1, 3)), MAX_DEGREE).numpy()
    values = values.reshape(*looks.shape[:2], n_coefficients(MAX_DEGREE))
    all_around = np.eye(n_coefficients(MAX_DEGREE)) / (4 * np.pi)
    sums: np.ndarray = values.transpose(0, 2, 1) @ values + all_around
    return sums
