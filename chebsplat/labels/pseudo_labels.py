"""Pseudo labels with a confidence by pixel, as features that a scene can learn."""

from __future__ import annotations

import numpy as np

IGNORE = -1


def voted(
    labels: np.ndarray, confidence: np.ndarray, class_codes: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of cells of factor x factor pixels, in which every pixel votes for its label as much as it is sure.

    Args: labels i16 [H, W], IGNORE none; confidence [H, W] in [0, 1]; class_codes [L, C] unit.
    Returns: features f32 [h, w, C]: the unit mean of the class codes by votes, zero without a vote; labels i16 [h, w]
      with the most votes, IGNORE without any; confidence f32 [h, w]: the votes for it by pixel.
    Choices: a cell at the right or lower edge has fewer pixels. Confidences decide what a cell of several labels is
      taught, and weigh it in the loss (`training.semantic_loss`); a cell without any is taught nothing.
    """
    height, width = labels.shape
    h, w = -(-height // factor), -(-width // factor)
    rows, columns = np.indices(labels.shape) // factor
    cell, counts = rows * w + columns, labels != IGNORE
    at = cell[counts] * len(class_codes) + labels[counts]
    votes = np.bincount(at, confidence[counts], h * w * len(class_codes)).reshape(h * w, -1)
    mean = votes @ class_codes
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    features = np.divide(mean, length, out=np.zeros_like(mean), where=length > 1e-6)
    pixels = np.bincount(cell.ravel(), minlength=h * w)
    winner = np.where(votes.sum(1) > 0, votes.argmax(1), IGNORE)
    shares = (votes.max(1) / pixels).astype(np.float32)
    features = features.astype(np.float32).reshape(h, w, class_codes.shape[1])
    return features, winner.astype(np.int16).reshape(h, w), shares.reshape(h, w)
