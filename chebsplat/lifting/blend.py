"""What the views say of a Gaussian and what is known beforehand, blended by evidence (the start of Eq 10's gate)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chebsplat.lifting.smoothing import Affinities, smooth

STRENGTHS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # views that knowledge may count for, as halves try them
ALIKE = 0.2  # correlation of the errors of two views of a thing
TRUST = 2.0  # over the strength that the halves ask for


class Calibration(NamedTuple):
    """What the training views decide.

    smooth:   features are smoothed before they are blended.
    strength: k, views that knowledge counts for; 0: it is left out.
    curve:    for off and on, the agreement of the halves, mean cosine, at each strength that was tried.
    """

    smooth: bool
    strength: float
    curve: dict[str, dict[float, float]]

    def best_strength(self, smoothed: bool) -> float:
        """The strength of the largest agreement where smoothing is decided by others; the least of equal ones."""
        row = self.curve["on" if smoothed else "off"]
        return TRUST * max(row, key=lambda k: (row[k], -k))


def blend(features: np.ndarray, n_views: np.ndarray, knowledge: np.ndarray, strength: float) -> np.ndarray:
    """(n' f + k g) / (n' + k), f32 [N, C], with n' of `effective`.

    Args: features f [N, C]; n_views n [N] >= 0; knowledge g [N, C], a row of zeros where nothing is known;
          strength k >= 0.
    Choices: f where n + k is 0, and where g is a row of zeros, which is no answer.
    """
    n = effective(n_views)[:, None]
    k = np.float32(strength) * knowledge.any(1, keepdims=True).astype(np.float32)
    total = n + k
    blended = (n * features + k * knowledge) / np.where(total > 0, total, 1)
    return np.where((total > 0) & (k > 0), blended, features).astype(np.float32)


def effective(n_views: np.ndarray) -> np.ndarray:
    """n' = n / (1 + ALIKE (n - 1)): how many views with errors of their own n views are worth, f32 [N].

    Choices: a teacher errs alike in neighbouring views, so that a hundred of them never count for more than five. ALIKE
      was chosen with TRUST on generated rooms that knowledge is taught on the likes of, never on a scene's test views.
    """
    n = n_views.astype(np.float32)
    return np.asarray(n / (1 + ALIKE * np.maximum(n - 1, 0)), np.float32)


def calibrate(
    halves: np.ndarray, half_views: np.ndarray, near: Affinities, knowledge: np.ndarray | None = None
) -> Calibration:
    """Whether to smooth and how far to trust knowledge: what makes half the training views agree with the other half.

    Args: halves [2, N, C], features by each half of the training views; half_views [2, N] how many of them see each;
          near: affinities of the Gaussians; knowledge [N, C], or None: only smoothing is decided.
    Returns: the choice of the largest agreement: the cosine between what is made of one half (smoothed, blended by its
      own views) and the other half's mean features, averaged over the Gaussians that both see, by the other half's
      views, both ways alike.
    Choices: no test view is looked at, and no label. On ties, and without a Gaussian that both halves see, what changes
      less wins. What the teacher gets wrong in all views alike counts as right here, so that the halves ask for too
      little: the strength is TRUST times what they ask for.
    """
    strengths = STRENGTHS if knowledge is not None else STRENGTHS[:1]
    weights = np.where((half_views > 0).all(0), half_views, 0).astype(np.float64)
    curve: dict[str, dict[float, float]] = {"off": {}, "on": {}}
    for name in curve:
        made = [smooth(*of, near) if name == "on" else of[0] for of in zip(halves, half_views, strict=True)]
        for k in strengths:
            agreed = 0.0
            for own, other in ((0, 1), (1, 0)):
                result = made[own] if knowledge is None else blend(made[own], half_views[own], knowledge, k)
                agreed += float(weights[other] @ cosines(result, halves[other]))
            curve[name][k] = agreed / max(float(weights.sum()), 1.0)
    best = max(((value, name == "off", -k) for name, row in curve.items() for k, value in row.items()))
    return Calibration(not best[1], -TRUST * best[2], curve)


def confidence(
    features: np.ndarray,
    n_views: np.ndarray,
    agreement: np.ndarray,
    knowledge: np.ndarray | None = None,
    strength: float = 0.0,
) -> np.ndarray:
    """How long the mean of all votes is beside one vote for nothing: |n r f/|f| + k g/|g|| / (n + k + 1), f32 [N].

    Args: agreement r [N] in [0, 1] of the views; the others as for `blend`.
    """
    direction = features / np.linalg.norm(features, axis=1, keepdims=True).clip(1e-12)
    votes, total = (n_views * agreement)[:, None] * direction, n_views + 1.0
    if knowledge is not None:
        lengths = np.linalg.norm(knowledge, axis=1, keepdims=True)
        votes, total = votes + strength * knowledge / lengths.clip(1e-12), total + strength * (lengths[:, 0] > 0)
    return (np.linalg.norm(votes, axis=1) / total).clip(0, 1).astype(np.float32)  # type: ignore[no-any-return]


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosine of each row's angle, f64 [N]; 0 where a row is zero."""
    lengths = np.linalg.norm(a, axis=1).astype(np.float64) * np.linalg.norm(b, axis=1)
    return np.einsum("nc,nc->n", a, b) / np.where(lengths > 0, lengths, 1)  # type: ignore[no-any-return]
