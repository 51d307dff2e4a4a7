"""Lessons of scenes about shape, in closed form: sums over a scene's points, and the map from shape
to meaning that many scenes' sums give. They commute, so that no scene is forgotten and no order
matters (docs/method.md, section 14).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh

from chebsplat.errors import DataFailure

SHIPPED_WORTH = 3.0  # scenes that what ships counts for
RIDGE = 1e-2  # in units of the diagonal of A
LEAST_VIEWS = 2  # that a point to learn from was seen in
ENERGY = 0.99  # of what was learned, that the basis holds
LEAST_OF_CLASS = 1e-3  # of the weight of all points, that those of a class need for a mean
ZERO = 1e-12  # of the largest of diag A, up to which a feature counts as zero everywhere
KAPPA = 0.1  # of ρ′ = ρ (1 + κ σ_f)


class Sums(NamedTuple):
    """Of N points with features z [p] of shape and y [C] of meaning, weights w that add up to 1.

    gram:  A = Σ w z zᵀ, f64 [p, p]; cross: b = Σ w z yᵀ, f64 [p, C]; square: c = Σ w |y|².
    """

    gram: np.ndarray
    cross: np.ndarray
    square: float

    def spread(self) -> float:
        """σ_f = √(Σ w |y − ȳ|²) of the meanings (Eq 15); z ends in 1, so b's last row is ȳ."""
        return float(np.sqrt(max(self.square - float(self.cross[-1] @ self.cross[-1]), 0.0)))


def summed(features: np.ndarray, meanings: np.ndarray, weights: np.ndarray) -> Sums:
    """Sums of points with z [N, p], y [N, C] and w [N] >= 0, not all zero.

    Raises: ValueError where no point has a weight.
    """
    total = float(weights.sum())
    if not total > 0:
        raise ValueError("no point has a weight: nothing can be learned")
    w = (weights / total).astype(np.float64)[:, None]
    z, y = features.astype(np.float64), meanings.astype(np.float64)
    return Sums(z.T @ (w * z), z.T @ (w * y), float(np.sum(w * y * y)))


def odds(n_views: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Weight of each of N points in a lesson, f64 [N], sum 1: half alike, half by 1 /
    sqrt(frequency of its label).

    Args: n_views [N], that see it; labels [N] that it is taught with.
    Raises: DataFailure where none is seen in LEAST_VIEWS views.
    """
    visible = (n_views >= LEAST_VIEWS).astype(np.float64)
    if not visible.any():
        raise DataFailure(f"no point is seen in {LEAST_VIEWS} views")
    rare = visible / np.sqrt(np.maximum(np.bincount(labels, visible), 1)[labels])
    return np.asarray(0.5 * visible / visible.sum() + 0.5 * rare / rare.sum())


def combined(sums: Sequence[Sums], weights: Sequence[float]) -> Sums:
    """Σ g_k S_k of sums S_k with weights g_k.

    Choices: added in the order given, so that equal sets in equal order give equal bits.
    """
    gram, cross = np.zeros_like(sums[0].gram), np.zeros_like(sums[0].cross)
    square = 0.0
    for of, weight in zip(sums, weights, strict=True):
        gram += weight * of.gram
        cross += weight * of.cross
        square += weight * of.square
    return Sums(gram, cross, square)


def mean_of(sums: Sequence[Sums]) -> Sums:
    """The mean of sums, one or more."""
    return combined(sums, [1 / len(sums)] * len(sums))


def alive(diagonal: np.ndarray) -> np.ndarray:
    """True for features that are not zero everywhere, bool [p], by diag A [p]."""
    return np.asarray(diagonal > ZERO * diagonal.max())


def solved(sums: Sums, ridge: float) -> np.ndarray:
    """W = (A + λ diag A)⁻¹ b, f64 [p, C], λ the ridge.

    Features that are zero everywhere get no weight.
    """
    diagonal = np.diag(sums.gram)
    used = alive(diagonal)
    scale = 1 / np.sqrt(np.where(used, diagonal, 1))
    correlation = sums.gram * scale[:, None] * scale + np.diag(np.where(used, ridge, 1.0))
    scaled = cho_solve(cho_factor(correlation, lower=True), sums.cross * scale[:, None])
    return np.asarray(scaled * (scale * used)[:, None])


def class_means(sums: Sums, embeddings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean features z of the points of each class, f64 [K, p], and which classes these are, i64
    [K], in order: those of LEAST_OF_CLASS of the weight.

    Args: sums: of points whose y is their class's embedding; embeddings [L, C]: of L <= C
      classes, linearly independent.
    Choices: b is Σ_l (Σ w z over class l) e_lᵀ, which the embeddings' pseudo-inverse takes apart; z
      ends in 1, so that its last row is each class's share of the weight.
    """
    by_class = sums.cross @ np.linalg.pinv(embeddings.astype(np.float64))
    present = np.flatnonzero(by_class[-1] >= LEAST_OF_CLASS)
    return (by_class[:, present] / by_class[-1, present]).T, present


def unexplained(sums: Sums, answers: np.ndarray) -> float:
    """Share of the meanings' square that a map W [p, C] leaves: (c - 2 <W, b> + <W, A W>) / c."""
    left = sums.square - 2 * np.sum(answers * sums.cross) + np.sum(answers * (sums.gram @ answers))
    return float(left / max(sums.square, 1e-300))


def mapped(shipped: Sequence[Sums], lessons: Sequence[Sums], trust: Sequence[float]) -> np.ndarray:
    """The map W f64 [p, C] that shipped sums and lessons give.

    Args: trust: of each lesson, in [0, 1].
    Choices: SHIPPED_WORTH and RIDGE are the same for every scene (docs/method.md, section 14).
    """
    weights = [*[SHIPPED_WORTH / len(shipped)] * len(shipped), *trust]
    return solved(combined([*shipped, *lessons], weights), RIDGE)


def scale_of(sums: Sums) -> np.ndarray:
    """1 / √diag A [p], by which features are compared; 0 for those that are zero everywhere."""
    diagonal = np.diag(sums.gram)
    return np.where(alive(diagonal), 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)


def basis(sums: Sums, scale: np.ndarray) -> np.ndarray:
    """B f64 [p, r]: eigenvectors of the correlation of what was learned, to ENERGY of it (Eq 15).

    Args: sums: of what was learned; scale [p]: of its features, by `scale_of`.
    Returns: orthonormal columns, the one of most energy first.
    """
    values, vectors = eigh(sums.gram * scale[:, None] * scale)
    share = np.cumsum(values[::-1]) / values.sum()
    return np.ascontiguousarray(vectors[:, ::-1][:, : int(np.searchsorted(share, ENERGY)) + 1])


def novelty(sums: Sums, scale: np.ndarray, B: np.ndarray) -> float:
    """ρ = √(share of a scene's energy that lies outside B) in [0, 1] (Eq 15).

    Args: sums: of the scene; scale [p]: that B was made with; B [p, r]: by `basis`.
    """
    correlation = sums.gram * scale[:, None] * scale
    inside = float(np.sum(B * (correlation @ B)))
    return float(np.sqrt(np.clip(1 - inside / np.trace(correlation), 0, 1)))


def scaled_novelty(rho: float, spread: float) -> float:
    """ρ′ = ρ (1 + κ σ_f) (Eq 15)."""
    return rho * (1 + KAPPA * spread)
