"""The exposure and white balance that photos were taken with, measured where several of them show the same points.

Exposures are f64 [V, 3]: stops (logarithms to base 2) of linear light by channel, of the mean view 0.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from chebsplat.cameras import centers

CELL = 8  # pixels: colours of a point are means over squares of this side
MOST_POINTS, LEAST_POINTS = 4000, 30  # points that are looked at, and of a view whose exposure is told
DARK, BRIGHT = 0.005, 0.85  # linear light beyond which a sensor's curve or its end tells instead of the exposure
ROUNDS = 30  # of medians by point and by view, in turns
REACHES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # of `own_part`: how far apart views share, in median distances and radians
RATIOS = 10.0 ** np.arange(-4, 4.1, 0.25)  # what is a photo's own over what is shared, as variances
BRIGHTNESS_AND_HUES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # orthonormal


def light_of(values: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, both from 0 to 1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def relit(image: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """An image u8 [H, W, 3] as it would be with so many more stops [3]; what is too bright is cut off."""
    lit = np.minimum(light_of(np.arange(256) / 255)[:, None] * 2.0 ** np.asarray(stops), 1)
    tables = np.where(lit <= 0.0031308, 12.92 * lit, 1.055 * lit ** (1 / 2.4) - 0.055)
    tables = (255 * tables).round().astype(np.uint8)
    return np.stack([tables[image[..., channel], channel] for channel in range(3)], -1)


def measured_exposures(
    images: Iterable[np.ndarray],
    Ks: np.ndarray,
    cam_from_world: np.ndarray,
    points: np.ndarray,
    seen: np.ndarray | None = None,
) -> np.ndarray:
    """Exposures [V, 3] of V photos of the same points; NaN of those that show too few of them.

    Args: images: u8 [H, W, 3] of V views; Ks [V, 3, 3] pixels; cam_from_world [V, 4, 4]; points [N, 3]; seen: bool
      [N, V], or None: by all views that have the point within their frame.
    Choices: light is that of a point times its view's exposure. Both are medians, by turns, so that walls in between
      and highlights count little.
    """
    chosen = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).astype(int)
    logs = np.full((len(chosen), len(Ks), 3), np.nan)
    light = light_of(np.arange(256) / 255)
    for view, image in enumerate(images):
        height, width = image.shape[:2]
        half = min(CELL, height, width) // 2
        camera = points[chosen] @ cam_from_world[view, :3, :3].T + cam_from_world[view, :3, 3]
        front = camera[:, 2] > 1e-3
        place = ((camera / np.where(front, camera[:, 2], 1)[:, None]) @ Ks[view].T)[:, :2]
        inside = front & ((place >= half) & (place <= np.array([width, height]) - half)).all(1)
        if seen is not None:
            inside &= seen[chosen, view]
        sums = np.pad(light[image].cumsum(0).cumsum(1), ((1, 0), (1, 0), (0, 0)))
        x, y = place[inside].astype(int).T
        right, left = (sums[y + half, end] - sums[y - half, end] for end in (x + half, x - half))
        means = (right - left) / (2 * half) ** 2
        logs[inside, view] = np.log2(np.where((means > DARK) & (means < BRIGHT), means, np.nan))
    logs[np.isnan(logs).any(2)] = np.nan
    logs = logs[np.isfinite(logs[..., 0]).sum(1) >= 2]
    enough = np.isfinite(logs[..., 0]).sum(0) >= LEAST_POINTS
    exposures = np.full((len(Ks), 3), np.nan)
    if enough.sum() < 2:
        return exposures
    logs, found = logs[:, enough], np.zeros((enough.sum(), 3))
    logs = logs[np.isfinite(logs[..., 0]).any(1)]
    for _ in range(ROUNDS):
        of_points = np.nanmedian(logs - found, axis=1, keepdims=True)
        found = np.nanmedian(logs - of_points, axis=0)
        found -= found.mean(0)
    exposures[enough] = found
    return exposures


def own_part(exposures: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """What of exposures [V, 3] is a photo's own, and not shared by the views about it; 0 where they are NaN.

    Choices: what changes smoothly with where a camera stands and looks is left in the photos: views between them, test
      views too, have it, and a scene can show it. Exposures are a Gaussian process over camera centres, in median
      distances, and directions (Matérn, 3/2), plus noise that is each photo's own; its reach and the noise's share are
      those of the largest marginal likelihood, by brightness and by hue.
    """
    own = np.zeros_like(exposures)
    known = np.isfinite(exposures).all(1)
    if known.sum() < 3:
        return own
    eye, forward = centers(cam_from_world[known]), cam_from_world[known, 2, :3]
    apart = np.linalg.norm(eye[:, None] - eye, axis=-1)
    place = np.concatenate([eye / (np.median(apart[apart > 0]) if apart.any() else 1.0), forward], 1)
    distance = np.sqrt(3) * np.linalg.norm(place[:, None] - place, axis=-1)
    kernels = ((1 + distance / reach) * np.exp(-distance / reach) for reach in REACHES)
    spectra = [tuple(np.linalg.eigh(kernel)) for kernel in kernels]
    axes = exposures[known] @ BRIGHTNESS_AND_HUES.T
    parts = np.stack([_noise_of(values, spectra) for values in axes.T], 1)
    own[known] = parts @ BRIGHTNESS_AND_HUES
    return own


def _noise_of(values: np.ndarray, spectra: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """The noise in values [V] of unknown mean, whose covariance is one of these (eigenvalues, eigenvectors) plus one of
    RATIOS, times a factor.
    """
    if np.ptp(values) < 1e-9:
        return np.zeros_like(values)
    best, noise = -np.inf, np.zeros_like(values)
    for eigenvalues, vectors in spectra:
        rotated, ones = vectors.T @ values, vectors.sum(0)
        for ratio in RATIOS:
            weights = 1 / (eigenvalues.clip(0) + ratio)
            total = (weights * ones**2).sum()
            residual = rotated - (weights * ones * rotated).sum() / total * ones
            square = (weights * residual**2).sum()
            likelihood = -(len(values) - 1) * np.log(square) + np.log(weights).sum() - np.log(total)
            if likelihood > best:
                best, noise = likelihood, vectors @ (ratio * weights * residual)
    return noise
