"""Blend of the views' features with prior knowledge, by evidence (the start of Eq 10's gate)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from chebsplat.labels.decode import decode, decode_labels
from chebsplat.lifting.smoothing import Affinities, smooth

STRENGTHS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # views that knowledge may count for
ALIKE = 0.2  # correlation of the errors of two views of a thing, at most
SURE = 3  # power of its length by which knowledge counts
# power by which views count of how far their halves agree, and of how sure they are beside shape
AGREED = 6
# An error that a teacher repeats in both halves counts as agreement, however many views there are.
LEAST = 1.0  # strength
# of what both halves see: a label of less has so much less to say about the strength
LEAST_OF_LABEL = 1e-3
BELIEVED = 0.6, 0.7  # share of labels of shape that equal those of a teacher sure of the scene
LEAST_SHARE = 0.5  # strength, in mean evidence of a Gaussian that is seen


class Shape(NamedTuple):
    """Answers of knowledge of shape for N Gaussians.

    answers:       g, f32 [N, C], the surer the longer.
    embeddings:    [L, C] of the scene's labels.
    confused_with: i64 [L], the label that shape mostly gives to things of each label.
    """

    answers: np.ndarray
    embeddings: np.ndarray
    confused_with: np.ndarray

    def beside(self, features: np.ndarray) -> np.ndarray:
        """Answers that count beside features of views [N, C], zero where unseen: none where shape
        gives the label that it mostly gives to things of the label that the views give.
        """
        by_views, by_shape = (decode_labels(of, self.embeddings) for of in (features, self.answers))
        blind = (self.confused_with[by_views] == by_shape) & (by_views != by_shape)
        blind &= features.any(1)
        return np.where(blind[:, None], 0, self.answers).astype(np.float32)


class Calibration(NamedTuple):
    """Choices that the training views decide.

    smooth:   features are smoothed, after they are blended.
    strength: k, views that knowledge counts for; 0: it is left out.
    curve:    agreement of the halves, mean cosine, by `calibrate`: for off at each strength that
      was tried, for on of smoothed features without knowledge.
    """

    smooth: bool
    strength: float
    curve: dict[str, dict[float, float]]


def blend(
    features: np.ndarray, evidence: np.ndarray, knowledge: np.ndarray, strength: float
) -> np.ndarray:
    """(e f + k' g) / (e + k'), f32 [N, C], with k' of `trusted`; f where that is 0.

    Args: features f [N, C]; evidence e [N] >= 0, see `effective` and `reliable`; knowledge g [N,
      C]; strength k >= 0.
    """
    e, k = evidence[:, None], trusted(knowledge, strength)[:, None]
    blended = (e * features + k * knowledge) / np.where(e + k > 0, e + k, 1)
    return np.where(k > 0, blended, features).astype(np.float32)


def trusted(knowledge: np.ndarray, strength: float) -> np.ndarray:
    """k' = k |g|^SURE: views that knowledge counts for, f32 [N].

    Choices: an answer is the mean of unit vectors of a teacher over views, so that its length is
      how alike these were where shapes were like this one; small things, of which shape reveals
      least, are left to the views.
    """
    return np.asarray(strength * lengths(knowledge).clip(0, 1) ** SURE, np.float32)


def effective(n_views: np.ndarray, alike: float = ALIKE) -> np.ndarray:
    """n' = n / (1 + a (n - 1)): independent views that n views are worth, f32 [N].

    Args: alike: a, correlation of the errors of two views, see `errors_alike`.
    Choices: at ALIKE a hundred views count for no more than five.
    """
    n = n_views.astype(np.float32)
    return np.asarray(n / (1 + alike * np.maximum(n - 1, 0)), np.float32)


def errors_alike(agreement: np.ndarray, halves: np.ndarray, half_views: np.ndarray) -> float:
    """Correlation a of the errors of two views that are near each other, in [0, ALIKE].

    Args: agreement r [N] of all views; halves [2, N, C] and half_views [2, N] as for `reliable`.
    Returns: by how much more the halves differ than 1 - r^2 of single views explains if errors were
      independent; ALIKE where no Gaussian is seen by two views of each half.
    Choices: halves are of blocks of neighbouring views, so that an error that neighbours share
      sets them apart. One that all views share does not show; hence ALIKE for teachers with more
      (0.3 to 0.5 of the embedded one). Noisy labels have 0.
    """
    both = (half_views >= 2).all(0)
    n, r = half_views[:, both].astype(np.float64), agreement[both].astype(np.float64)
    spread = (1 - r**2) * n.sum(0) / (n.sum(0) - 1)
    if not spread.sum() > 0:
        return ALIKE
    apart = 2 * (1 - cosines(*halves[:, both])) * r**2
    independent, common = spread * (1 / n).sum(0), spread * (1 - 1 / n).sum(0)
    return float(np.clip((apart.sum() - independent.sum()) / common.sum(), 0, ALIKE))


def reliable(halves: np.ndarray, half_views: np.ndarray) -> np.ndarray:
    """ρ^AGREED, f32 [N]: weight of views whose two halves agree by a cosine of ρ.

    Args: halves [2, N, C], features by each half of the views; half_views [2, N] how many of them
      see each.
    Choices: the mean ρ where only one half sees a Gaussian, 1 where none is seen by both. Views
      whose errors are their own agree in their means however wrong each is; a teacher out of its
      depth gives other labels from elsewhere.
    """
    both, agreed = (half_views > 0).all(0), cosines(*halves).clip(0, 1)
    mean = float(agreed[both].mean()) if both.any() else 1.0
    return np.asarray(np.where(both, agreed, mean) ** AGREED, np.float32)


def familiar(lifted: np.ndarray, knowledge: np.ndarray, embeddings: np.ndarray) -> float:
    """σ^AGREED, σ = min(c / c', 1): weight of views that are sure of labels by c, where shape is by
    c'.

    Args: lifted [N, C], the views' features of Gaussians, zero where unseen; knowledge [N, C];
      embeddings [L, C] of the scene's labels.
    Returns: in (0, 1]; 1 where no view sees a Gaussian.
    Choices: c and c' are mean confidences of `decode`. Views may agree and all be wrong: a teacher
      far from what it was trained on is unsure of labels from everywhere. Of a scene, not of a
      Gaussian: small things have no sure label in either, and are the views' to tell. Gaussians
      that no view sees do not count: few photos leave many, which is not the teacher's fault.
    """
    visible = lifted.any(1)
    if not visible.any():
        return 1.0
    sure, beside = (
        float(decode(rows[visible], embeddings)[1].mean()) for rows in (lifted, knowledge)
    )
    return min(sure / beside, 1.0) ** AGREED


def believed(
    lifted: np.ndarray,
    n_views: np.ndarray,
    knowledge: np.ndarray,
    embeddings: np.ndarray,
    worth: float,
) -> float:
    """Trust in shape in a scene, in [0, 1], before its strength is chosen.

    Args: as for `familiar`; n_views [N] that see each Gaussian; worth: of `familiar`.
    Choices: where a teacher knows the scene and many labels of shape, weighed by how sure it is of
      them, are not its own, it is shape that is wrong: another world than it was taught in. Below
      BELIEVED the trust is 0, above it 1. A teacher that is unsure of the scene is no judge.
    """
    visible = (n_views >= 2) & lifted.any(1)
    if not visible.any():
        return 1.0
    alike = decode_labels(lifted[visible], embeddings) == decode_labels(
        knowledge[visible], embeddings
    )
    sure = trusted(knowledge[visible], 1.0)
    share = float(alike @ sure / max(float(sure.sum()), 1e-12))
    alike_enough = float(np.clip((share - BELIEVED[0]) / (BELIEVED[1] - BELIEVED[0]), 0, 1))
    return max(alike_enough, 1 - worth)


def halves_agree(
    halves: np.ndarray, half_views: np.ndarray, refined: Sequence[np.ndarray] | None = None
) -> float:
    """Agreement of the two halves of the training views: mean cosine, by views, of what is made of
    one half and the other half as it is, both ways. 0 without a Gaussian that both see.

    Args: halves [2, N, C], features by each half; half_views [2, N] how many of them see each;
      refined: what is made of each half, None: nothing.
    """
    weights = np.where((half_views > 0).all(0), half_views, 0).astype(np.float64)
    return _agreement(list(halves) if refined is None else refined, halves, weights)


def _agreement(predicted: Sequence[np.ndarray], halves: np.ndarray, weights: np.ndarray) -> float:
    """Mean cosine of what each half predicts and the other half, weighted by the other's [2, N]."""
    both = sum(float(weights[1 - own] @ cosines(predicted[own], halves[1 - own])) for own in (0, 1))
    return both / max(float(weights.sum()), 1e-30)


def calibrate(
    halves: np.ndarray,
    half_views: np.ndarray,
    near: Affinities,
    shape: Shape | None = None,
    alike: float = ALIKE,
) -> Calibration:
    """Choice of smoothing and of knowledge's strength: those by which half the views predict the
    rest.

    Args: halves [2, N, C], features by each half of the training views; half_views [2, N] how many
      of them see each; near: affinities of the Gaussians; shape: None: only smoothing is decided;
      alike: as for `effective`.
    Returns: whether smoothing alone makes the halves agree better, and the strength at which they
      agree best, of those from LEAST and from LEAST_SHARE of the mean evidence up; both fall to 0
      with `alike`, since halves show errors that are not alike. Agreement is the cosine between
      what is made of one half (smoothed, or blended by its own views) and the other half's mean
      features, averaged over the Gaussians that both see, by the other half's views and, where
      there is shape, every label of the views alike, both ways alike.
    Choices: no test view is looked at, and no true label. On ties, and without a Gaussian that both
      halves see, what changes less wins. The strength is that for features as they are: what
      smoothing has made of a half is no longer evidence of its views alone, and asks for less.
      Every label counts as much as another, as in mIoU: walls would choose for all.
    """
    reliability = reliable(halves, half_views)
    weights = np.where((half_views > 0).all(0), half_views, 0).astype(np.float64)
    if shape is not None:
        labels = decode_labels((half_views[..., None] * halves).sum(0), shape.embeddings)
        of_label = np.bincount(labels, weights.sum(0))
        weights /= np.maximum(of_label, max(LEAST_OF_LABEL * of_label.sum(), 1))[labels]
    smoothed = [smooth(*of, near) for of in zip(halves, half_views, strict=True)]
    curve = {0.0: _agreement(list(halves), halves, weights)}
    on = _agreement(smoothed, halves, weights)
    strength = 0.0
    if shape is not None and weights.any():
        evidence = [effective(n, alike) * reliability for n in half_views]
        knowledge = [shape.beside(half) for half in halves]
        for k in STRENGTHS[1:]:
            blended = [blend(*of, k) for of in zip(halves, evidence, knowledge, strict=True)]
            curve[k] = _agreement(blended, halves, weights)
        whole, visible = effective(half_views.sum(0), alike) * reliability, half_views.any(0)
        least = max(LEAST, LEAST_SHARE * float(whole[visible].mean())) * alike / ALIKE
        strength = max((k for k in curve if k >= least), key=lambda k: (curve[k], -k))
    return Calibration(on > curve[0.0], strength, {"off": curve, "on": {0.0: on}})


def start(which: str, lifted: np.ndarray, trained: np.ndarray | None) -> np.ndarray:
    """Features [N, C] to refine: lifted, trained, or for `both` their mean direction, trained's
    length.

    Choices: training fits features to pictures, single views' errors too; lifting asks all views
      alike, and knows no picture. They err differently, so that their mean errs less.
    """
    if trained is None or which == "lifted":
        return lifted
    if which == "trained":
        return trained
    lengths = np.linalg.norm(trained, axis=1, keepdims=True)
    return np.asarray(lengths * unit(unit(trained) + unit(lifted)), np.float32)


def confidence(
    features: np.ndarray,
    n_views: np.ndarray,
    agreement: np.ndarray,
    knowledge: np.ndarray | None = None,
    strength: float = 0.0,
    worth: float = 1.0,
    alike: float = ALIKE,
) -> np.ndarray:
    """Length of the mean of all votes and a zero one: |n' r f/|f| + k' g/|g|| / (n' + k' + 1), f32
    [N].

    Args: agreement r [N] in [0, 1] of the views; worth: of `familiar`, which n' is multiplied by;
      alike: as for `effective`; the others as for `blend`.
    """
    n = effective(n_views, alike) * worth
    votes, total = (n * agreement)[:, None] * unit(features), n + 1
    if knowledge is not None:
        k = trusted(knowledge, strength)
        votes, total = votes + k[:, None] * unit(knowledge), total + k
    return np.asarray((np.linalg.norm(votes, axis=1) / total).clip(0, 1), np.float32)


def lengths(rows: np.ndarray) -> np.ndarray:
    """Lengths of rows [N, C], f64 [N]; of float32, too, squares neither vanish nor overflow."""
    return np.asarray(np.sqrt(np.einsum("nc,nc->n", rows, rows, dtype=np.float64)))


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length 1, or of zeros."""
    of = lengths(rows)
    return np.asarray(rows / np.where(of > 0, of, 1)[:, None].astype(rows.dtype))


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosine of each row's angle, f64 [N]; 0 where a row is zero."""
    both = lengths(a) * lengths(b)
    return np.asarray(np.einsum("nc,nc->n", a, b, dtype=np.float64) / np.where(both > 0, both, 1))
