"""Calibrated relevancy: how probably a place shows what a word means, and a scene has it at all.

A word is weighed against words that were the nearest of a teacher's vocabulary somewhere in
generated rooms, its rivals (docs/method.md, section 16). All vectors are of one space; features are
made unit, words are taken as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

CUT = 0.5  # of probabilities: likelier than not
# one of so many Gaussians, the likeliest ones, tell whether a scene has what a word means
STRONGEST = 1000
LEAST = 5  # of them, at least
BLOCK = 4_000_000  # cosines in memory at once


class Calibration(NamedTuple):
    """log-odds of a place: margin * (behind the best rival) + cosine * (with the word) + bias; of
    presence: the mean log-odds of a scene's likeliest places * strength + offset.
    """

    margin: float
    cosine: float
    bias: float
    strength: float
    offset: float


def evidence(features: np.ndarray, words: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """Cosine of each word less that of the best rival, <= 0 where it is one itself, and the cosine.

    Args: features [..., C] of any length; words [W, C]; rivals [K, C], K >= 1.
    Returns: f32 [..., W, 2]; a feature of length zero has the evidence of no word: nan.
    Raises:  ValueError on shapes that do not fit.
    """
    n_channels = features.shape[-1]
    if (
        words.ndim != 2
        or rivals.ndim != 2
        or not len(rivals)
        or {words.shape[1], rivals.shape[1]} != {n_channels}
    ):
        raise ValueError(
            f"features {features.shape}, words {words.shape} and rivals {rivals.shape} do not fit"
        )
    rows = features.reshape(-1, n_channels).astype(np.float32)
    scores = np.empty((len(rows), len(words), 2), np.float32)
    step = max(BLOCK // (len(rivals) + len(words)), 1)
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        lengths = np.linalg.norm(rows[part], axis=1, keepdims=True)
        directions = rows[part] / np.where(lengths > 0, lengths, np.nan)
        cosines = directions @ words.T.astype(np.float32)
        best = (directions @ rivals.T.astype(np.float32)).max(1)
        scores[part] = np.stack([cosines - best[:, None], cosines], 2)
    return scores.reshape(*features.shape[:-1], len(words), 2)


def probability(
    features: np.ndarray, word: np.ndarray, rivals: np.ndarray, of: Calibration
) -> np.ndarray:
    """Probability f32 [...] that features [..., C] show what `word` [C] means; 0 at length zero.

    Raises: ValueError on shapes that do not fit.
    """
    return probable(evidence(features, word[None], rivals)[..., 0, :], of)


def probable(scores: np.ndarray, of: Calibration) -> np.ndarray:
    """Probabilities f32 [...] by the `evidence` [..., 2] of one word; 0 where that is nan."""
    odds = of.margin * scores[..., 0].astype(np.float64) + of.cosine * scores[..., 1] + of.bias
    return np.where(np.isnan(odds), 0, _share(odds)).astype(np.float32)


def strongest(probabilities: np.ndarray) -> float:
    """Mean log-odds of the likeliest places, one in STRONGEST, at least LEAST; none: ValueError."""
    if not probabilities.size:
        raise ValueError("a scene of no places has nothing")
    count = min(max(probabilities.size // STRONGEST, LEAST), probabilities.size)
    likeliest = (
        np.partition(probabilities.ravel(), -count)[-count:].astype(np.float64).clip(1e-6, 1 - 1e-6)
    )
    return float(np.mean(np.log(likeliest / (1 - likeliest))))


def presence(probabilities: np.ndarray, of: Calibration) -> float:
    """Probability that a scene has what a word means, from `probabilities` of all its places."""
    return float(_share(np.array(of.strength * strongest(probabilities) + of.offset)))


def frequent(features: Sequence[np.ndarray], words: np.ndarray, least: float) -> np.ndarray:
    """Rows of words [W, C] nearest to more than a share `least` of all features [N, C]."""
    counts, total = np.zeros(len(words), np.int64), 0
    for rows in features:
        step = max(BLOCK // len(words), 1)
        for start in range(0, len(rows), step):
            nearest = (rows[start : start + step] @ words.T).argmax(1)
            counts += np.bincount(nearest, minlength=len(words))
        total += len(rows)
    return np.flatnonzero(counts > least * total)


def fitted(inputs: np.ndarray, truth: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Logistic regression: coefficients [D + 1], bias last, of the greatest likelihood of truth
    bool [N].

    Args: inputs [N, D]; weights [N], > 0; default: all alike.
    Raises: ValueError where only one outcome occurs.
    Choices: Newton's method with a ridge of 1e-6, which keeps separable data finite and moves no
      other.
    """
    if truth.all() or not truth.any():
        raise ValueError("both outcomes are needed")
    rows = np.concatenate([inputs, np.ones((len(inputs), 1))], 1).astype(np.float64)
    weights = np.ones(len(rows)) if weights is None else np.asarray(weights, np.float64)
    weights = weights / weights.sum()
    coefficients = np.zeros(rows.shape[1])
    for _ in range(50):
        shares = _share(rows @ coefficients)
        gradient = rows.T @ (weights * (shares - truth)) + 1e-6 * coefficients
        curvature = (rows * (weights * shares * (1 - shares))[:, None]).T @ rows + 1e-6 * np.eye(
            len(coefficients)
        )
        step = np.linalg.solve(curvature, gradient)
        # a far step would leave where the model is curved
        step /= max(1.0, float(np.abs(step).max()) / 5)
        coefficients -= step
        if np.abs(step).max() < 1e-8:
            break
    return coefficients


def _share(odds: np.ndarray) -> np.ndarray:
    """The logistic function, of log-odds of any size."""
    shares: np.ndarray = 1 / (1 + np.exp(-odds.clip(-500, 500)))
    return shares


def relevancy(
    features: np.ndarray, query: np.ndarray, against: np.ndarray, temperature: float = 0.1
) -> np.ndarray:
    """Smallest share of the query in a softmax with one of the phrases against it (LERF, 3.3).

    Args:
      features:    [..., C] of any length.
      query:       [C] embedding of the query; against: [K, C] of phrases that fit anything, K >= 1.
      temperature: of the softmax over a pair, > 0.
    Returns: f32 [...] in [0, 1]; above 0.5 where the query fits better than every one of the
      phrases.
    Raises:  ValueError on a shape that does not fit, or a temperature that is not positive.
    Choices: temperature 0.1, that of the labels' confidence, which the paper leaves to its code;
      features are made unit, embeddings are taken as they are, so that `channels` keeps the
      teacher's own inner products; a feature of length zero, of a place that no Gaussian covers, is
      relevant to nothing: 0.
    """
    n_channels = features.shape[-1]
    if (
        query.shape != (n_channels,)
        or against.ndim != 2
        or against.shape[1] != n_channels
        or not len(against)
    ):
        raise ValueError(
            f"features {features.shape}, query {query.shape} and phrases {against.shape} do not fit"
        )
    if not temperature > 0:
        raise ValueError("temperature must be positive")
    lengths = np.linalg.norm(features, axis=-1)
    directions = features / lengths[..., None].clip(1e-6)
    # the strongest phrase gives the smallest share
    margin = directions @ query - (directions @ against.T).max(-1)
    shares = 1 / (1 + np.exp(-margin.astype(np.float64) / temperature))
    return np.where(lengths > 0, shares, 0).astype(np.float32)
