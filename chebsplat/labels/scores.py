"""Kinds of a segmenter's outputs, told by their values, and the probabilities they stand for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import logit, softmax

SUM = 0.004  # that sums of probabilities may be off 1: those of bfloat16
RANGE = 1e-3  # that values may lie beyond what they cannot
SURE = 0.5  # that some sigmoid reaches; cosines with words stay below where none is negative
SCALE = 100.0  # of cosines before a softmax: CLIP's
UNSURE = 0.25  # a segmenter of photos is sure by .5 to .8
LEAST, NONE = 1e-6, 1e-12  # of a probability whose odds, or logarithm, are taken

LOGITS, SOFTMAX, SIGMOID, COSINES = "logits", "softmax", "sigmoid", "cosines"


def kind_of(maps: Sequence[np.ndarray]) -> str:
    """Kind of values [C, h, w] of windows: logits, or what a softmax, sigmoids or cosines give.

    Choices: sums of 1 over the classes are a softmax, whatever a resize made of its range; values
      of 0 to 1 are sigmoids if some class is surer than SURE; what else stays within -1 to 1 is
      cosines. Logits that small decide nothing: scaled as cosines, they keep their order.
    """
    low, high = min(values.min() for values in maps), max(values.max() for values in maps)
    if all((np.abs(values.sum(0) - 1) < SUM).all() for values in maps):
        return SOFTMAX
    if low < -1 - RANGE or high > 1 + RANGE:
        return LOGITS
    return SIGMOID if low >= -RANGE and high > SURE else COSINES


def logits_of(values: np.ndarray, kind: str) -> np.ndarray:
    """Logits [C, h, w] of values, which a softmax takes. Args: kind: as `kind_of` tells it.

    Choices: those of sigmoids are the logits that they were taken of.
    """
    logits: np.ndarray = values
    if kind == SOFTMAX:
        logits = np.log(values.clip(NONE))
    elif kind == SIGMOID:
        logits = logit(values.clip(LEAST, 1 - LEAST))
    elif kind == COSINES:
        logits = SCALE * values
    return logits


def probabilities(values: np.ndarray, kind: str) -> np.ndarray:
    """Of the classes, [C, h, w], of sum 1. Args: kind: as `kind_of` tells it."""
    shares: np.ndarray = softmax(logits_of(values, kind), axis=0)
    return shares


def sureness(confidence: float, n_classes: int) -> float:
    """Certainty of a mean confidence: 0 where all classes are alike, 1 where one is certain."""
    return (confidence * n_classes - 1) / (n_classes - 1) if n_classes > 1 else 1.0
