"""Blend of the views' features with prior knowledge, by evidence (the start of Eq 10's gate)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from chebsplat.labels.decode import decode, decode_labels

ALIKE = 0.2  # correlation of the errors of two views of a thing, at most
SURE = 3  # power of its length by which knowledge counts
# power by which views count of how far their halves agree, and of how sure they are beside shape
AGREED = 6
STRENGTH = 0.25, 16.0  # views that knowledge counts for: at least, and at most
# support of views by shape at which it is the least; it doubles for each .04 of support below that
SUPPORTED, DOUBLES = 0.93, 0.04
LEAST_OF_LABEL = 1e-3  # of what both halves see: a label of less has so much less to say
BELIEVED = 0.6, 0.7  # share of labels of shape that equal those of a teacher sure of the scene


class Shape(NamedTuple):
    """Answers of knowledge of shape for N Gaussians.

    answers:       g, f32 [N, C], the surer the longer.
    embeddings:    [L, C] of the scene's labels.
    confused_with: i64 [L], the label that shape mostly gives to things of each label.
    has_word:      bool [L]: shape has votes on a label.
    """

    answers: np.ndarray
    embeddings: np.ndarray
    confused_with: np.ndarray
    has_word: np.ndarray

    def beside(self, features: np.ndarray) -> np.ndarray:
        """Answers that count beside features of views [N, C], zero where unseen: none where shape
        gives the label that it mostly gives to things of the label that the views give.
        """
        by_views, by_shape = (decode_labels(of, self.embeddings) for of in (features, self.answers))
        blind = (self.confused_with[by_views] == by_shape) & (by_views != by_shape)
        blind &= features.any(1)
        return np.where(blind[:, None], 0, self.answers).astype(np.float32)

    def compared(
        self, features: np.ndarray, n_views: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gaussians by which views and shape can be compared, bool [N]: two views or more see them,
        the label that these give has a word, and shape has a vote. Of each of these M: whether
        both give one label, bool [M], and the vote's weight, f32 [M] by `trusted`.

        Args: features [N, C] of the views, zero where unseen; n_views [N] that see each.
        """
        answers, labels = self.beside(features), decode_labels(features, self.embeddings)
        rows = (n_views >= 2) & features.any(1) & answers.any(1) & self.has_word[labels]
        same = decode_labels(answers[rows], self.embeddings) == labels[rows]
        return rows, same, trusted(answers[rows], 1.0)


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

    Choices: an answer is the mean of the words of points of like shape, so that its length is how
      alike these were; small things, of which shape reveals least, are left to the views.
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


def believed(lifted: np.ndarray, n_views: np.ndarray, shape: Shape, worth: float) -> float:
    """Trust in shape in a scene, in [0, 1].

    Args: lifted [N, C], the views' features of Gaussians, zero where unseen; n_views [N] that see
      each; worth: of `familiar`.
    Choices: where a teacher knows the scene and many labels of shape, weighed by how sure it is of
      them, are not its own, it is shape that is wrong: another world than it was taught in. Below
      BELIEVED the trust is 0, above it 1. A teacher that is unsure of the scene is no judge.
    """
    _, same, sure = shape.compared(lifted, n_views)
    if not len(same):
        return 1.0
    share = float(same @ sure / max(float(sure.sum()), 1e-12))
    alike_enough = float(np.clip((share - BELIEVED[0]) / (BELIEVED[1] - BELIEVED[0]), 0, 1))
    return max(alike_enough, 1 - worth)


def supported(
    lifted: np.ndarray, n_views: np.ndarray, agreement: np.ndarray, shape: Shape
) -> float:
    """s = p / √π. p: share of labels on which shape and the mean of the views agree. π: mean cosine
    of two views; √π would be the accuracy of one view if errors were independent.

    Args: agreement r [N] of all views, the length of the mean of their unit vectors; the others as
      for `believed`.
    Returns: 1 where no Gaussian can be compared.
    Choices: π is the mean of (n r² - 1) / (n - 1); both means are weighed by how sure shape is.
      Views that contradict shape more than each other have errors in common, which no number of
      views shows.
    """
    rows, same, sure = shape.compared(lifted, n_views)
    if not sure.sum() > 0:
        return 1.0
    n, r = n_views[rows].astype(np.float64), agreement[rows].astype(np.float64)
    pairs = np.average(((n * r**2 - 1) / (n - 1)).clip(0, 1), weights=sure)
    return float(np.average(same, weights=sure) / np.sqrt(max(pairs, 1e-6)))


def strength_of(support: float, worth: float, belief: float) -> float:
    """Views k that knowledge counts for: ¼ · 2^((.93 - s) / .04), up to 16, times worth, at least
    ¼; all times belief.

    Args: support s of `supported`; worth of `familiar`; belief of `believed`.
    Choices: only shape corrects errors that views have in common. A teacher that is unsure of a
      scene has its views count for less already. The numbers were chosen on training views of half
      of the scenes of docs/results/shape.md.
    """
    least, most = STRENGTH
    doublings = min((SUPPORTED - support) / DOUBLES, math.log2(most / least))
    return max(least * math.pow(2, doublings) * worth, least) * belief


def halves_agree(
    halves: np.ndarray, half_views: np.ndarray, refined: Sequence[np.ndarray] | None = None
) -> float:
    """Agreement of the two halves of the training views: mean cosine, by views, of what is made of
    one half and the other half as it is, both ways. 0 without a Gaussian that both see.

    Args: halves [2, N, C], features by each half; half_views [2, N] how many of them see each;
      refined: what is made of each half, None: nothing.
    """
    weights = seen_by_both(half_views)
    results = halves if refined is None else refined
    total = sum(weights[1 - own] @ cosines(results[own], halves[1 - own]) for own in (0, 1))
    return float(total / max(weights.sum(), 1e-30))


def labels_agree(
    halves: np.ndarray,
    half_views: np.ndarray,
    embeddings: np.ndarray,
    refined: Sequence[np.ndarray] | None = None,
) -> float | None:
    """Share of one half's labels that the result of the other half reproduces, both ways; each
    label weighs the same. None without a Gaussian that both see.

    Args: embeddings [L, C] of the labels; the others as for `halves_agree`.
    """
    weights = seen_by_both(half_views)
    if not weights.any():
        return None
    labels = [decode_labels(of, embeddings) for of in halves]
    results = labels if refined is None else [decode_labels(of, embeddings) for of in refined]
    shares = []
    for own in (0, 1):
        other, count = labels[1 - own], weights[1 - own]
        of_label = np.bincount(other, count)
        count = count / np.maximum(of_label, max(LEAST_OF_LABEL * of_label.sum(), 1))[other]
        shares.append(count @ (results[own] == other) / count.sum())
    return float(np.mean(shares))


def seen_by_both(half_views: np.ndarray) -> np.ndarray:
    """Numbers of views [2, N] of Gaussians that both halves see, 0 of others."""
    return np.where((half_views > 0).all(0), half_views, 0).astype(np.float64)


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
