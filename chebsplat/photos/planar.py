"""Depth of what has no texture: patches of one colour continued as planes through their known
depth.

Of one photo, reduced. The 1 / z of a plane is linear in its pixels, whatever its slant.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

# by which any channel, in [0, 1], of two pixels side by side may differ within a patch
SAME = 0.012
SMALLEST = 40  # pixels of a patch
# pixels of known depth, of a patch that is continued, and their share of it
KNOWN, SHARE = 12, 0.05
PLANES, OWN = 3, 0.15  # of a patch at most; share of its known pixels that each must hold
# triples that a plane is looked for with; of its depth, within which a pixel lies on it
DRAWS, NEAR = 30, 0.015


def completed(depth: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Depth f32 [h, w] with what planes add, 0 where nothing is known.

    Args:    depth [h, w], 0: none; colors [h, w, 3] in [0, 1].
    Choices: patches are what neighbouring pixels of nearly one colour connect (SAME): edges of
      things and of rooms bound them, slow shades do not. A patch has up to PLANES planes, the one
      with most pixels first (RANSAC with a fixed seed, then least squares); an unknown pixel is of
      the plane whose own pixels are nearest in the photo.
    """
    result, label = depth.astype(np.float32).copy(), patches(colors)
    has_depth = depth > 0
    sizes, counts = (
        np.bincount(label.ravel()),
        np.bincount(label[has_depth], minlength=label.max() + 1),
    )
    for patch in np.flatnonzero(
        (sizes >= SMALLEST) & (counts >= np.maximum(KNOWN, SHARE * sizes)) & (counts < sizes)
    ):
        inside = label == patch
        pixels, missing = np.argwhere(inside & has_depth), np.argwhere(inside & ~has_depth)
        fits = planes(pixels, 1 / depth[inside & has_depth])
        if not fits:
            continue
        apart = np.stack([cKDTree(pixels[own]).query(missing)[0] for _, own in fits])
        values = np.stack([_design(missing) @ plane for plane, _ in fits])
        value = np.take_along_axis(values, apart.argmin(0)[None], 0)[0]
        result[missing[:, 0], missing[:, 1]] = np.where(
            value > 0, 1 / np.where(value > 0, value, 1), 0
        )
    return result


def patches(colors: np.ndarray) -> np.ndarray:
    """A number i64 [h, w] of the patch that each pixel of [h, w, 3] is in."""
    height, width = colors.shape[:2]
    place = np.arange(height * width).reshape(height, width)
    along, down = (np.abs(np.diff(colors, axis=axis)).max(-1) < SAME for axis in (1, 0))
    one = np.concatenate([place[:, :-1][along], place[:-1][down]])
    other = np.concatenate([place[:, 1:][along], place[1:][down]])
    graph = coo_matrix((np.ones(len(one)), (one, other)), shape=(place.size, place.size))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels.reshape(height, width), np.int64)


def planes(pixels: np.ndarray, inverse: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Planes of a patch: 1 / z as [3] coefficients of (row, column, 1), and which of its known
    pixels are on each.

    Args: pixels [P, 2] (row, column) and their 1 / z [P].
    """
    fits: list[tuple[np.ndarray, np.ndarray]] = []
    rng, left = np.random.default_rng(0), np.arange(len(pixels))
    design = _design(pixels)
    while len(fits) < PLANES and len(left) >= max(KNOWN, OWN * len(pixels)):
        triples = left[rng.integers(0, len(left), (DRAWS, 3))]
        # twice the triangle's pixels
        triples = triples[np.abs(np.linalg.det(design[triples])) > 0.5]
        if not len(triples):
            break
        tried = np.linalg.solve(design[triples], inverse[triples][..., None])[..., 0]
        on = np.abs(tried @ design[left].T / inverse[left] - 1) < NEAR
        own = left[on[on.sum(1).argmax()]]
        if len(own) < max(KNOWN, OWN * len(pixels)):
            break
        fits.append((np.linalg.lstsq(design[own], inverse[own], rcond=None)[0], own))
        left = np.setdiff1d(left, own)
    return fits


def _design(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
