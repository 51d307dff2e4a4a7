"""A dictionary of a scene's features: few rows that many Gaussians share, by two-byte indices."""

from __future__ import annotations

import numpy as np

MEANINGS = (512, 1024, 2048)  # rows: the fewest whose error is at most KEEPS, else the most
# root mean square, relative to the features'. Where 512 rows are farther off, mIoU varies by up to
# 1.7 points with the draw; of these rows it loses at most 0.14 (docs/usage.md)
KEEPS = 0.06
ROUNDS = 20  # of Lloyd's algorithm
DRAWS = 8  # of the initial rows
MOST = 100_000  # Gaussians in the rounds
BLOCK = 4_000_000  # distances in memory at once
SEED = 0


def shared_features(features: np.ndarray, n_meanings: tuple[int, ...] = MEANINGS) -> np.ndarray:
    """Features f32 [N, C], each replaced by the nearest of as few rows as KEEPS allows.

    Args:    n_meanings: numbers of rows to try, from the fewest on.
    Choices: features of zero (no meaning) stay zero and take no row; all stay where no more than
      the fewest rows differ.
    """
    nonzero = features.any(1)
    rows = features[nonzero]
    if len(np.unique(rows, axis=0)) <= n_meanings[0]:
        return features
    unit = np.abs(rows).max()  # squares of values far from 1 overflow
    rows = rows / unit
    for n_rows in n_meanings:
        centers = _centers(rows, n_rows)
        near = centers[_nearest(rows, centers)]
        if np.sum((near - rows) ** 2, dtype=float) <= KEEPS**2 * np.sum(rows**2, dtype=float):
            break
    shared = np.zeros_like(features)
    shared[nonzero] = unit * near
    return shared


def _centers(rows: np.ndarray, n_meanings: int) -> np.ndarray:
    """Centres f32 [n_meanings, C] of rows [N, C] by k-means, fewer where fewer rows differ.

    Choices: from rows drawn in DRAWS turns, each by squared distance to the rows before, so that
      rare features get rows, too.
    """
    generator = np.random.default_rng(SEED)
    drawn = rows[generator.permutation(len(rows))[:MOST]]
    share = n_meanings // DRAWS
    centers = drawn[: n_meanings - share * (DRAWS - 1)]
    for _ in range(DRAWS - 1):
        off = ((drawn - centers[_nearest(drawn, centers)]) ** 2).sum(1, dtype=np.float64)
        if count := min(share, int(np.count_nonzero(off))):
            further = generator.choice(len(drawn), count, replace=False, p=off / off.sum())
            centers = np.concatenate([centers, drawn[further]])
    for _ in range(ROUNDS):
        nearest = _nearest(drawn, centers)
        counts = np.bincount(nearest, minlength=len(centers))[:, None]
        sums = [np.bincount(nearest, channel, len(centers)) for channel in drawn.T]
        means = np.stack(sums, 1) / counts.clip(1)
        centers = np.where(counts > 0, means, centers).astype(np.float32)
    return centers


def _nearest(rows: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Index of the nearest of centers [K, C] to each of rows [N, C], i64 [N]."""
    half = 0.5 * (centers**2).sum(1)
    blocks = np.array_split(rows, len(rows) * len(centers) // BLOCK + 1)
    return np.concatenate([(block @ centers.T - half).argmax(1) for block in blocks])
