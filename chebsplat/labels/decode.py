"""From features to labels: the label whose embedding has the largest cosine."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

TEMPERATURE = 0.1  # of cosines
BLOCK = 4_000_000  # cosines that are held at once


def decode(features: np.ndarray, embeddings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Label of the largest cosine, and its confidence.

    Args: features [..., C] of any length; embeddings [L, C] unit, or what `channels` keeps of them.
    Returns: labels i16 [...], confidence f32 [...]: softmax of cosines at temperature 0.1, its largest entry.
    """
    labels, confidence = (np.zeros(features.shape[:-1], kind) for kind in (np.int16, np.float32))
    for rows, cosines in _cosines(features, embeddings):
        labels.reshape(-1)[rows] = cosines.argmax(-1)
        weights = np.exp((cosines - cosines.max(-1, keepdims=True)) / TEMPERATURE)
        confidence.reshape(-1)[rows] = 1 / weights.sum(-1)
    return labels, confidence


def decode_labels(features: np.ndarray, embeddings: np.ndarray) -> np.ndarray:
    """The labels of `decode` alone, for a third of its time."""
    labels = np.zeros(features.shape[:-1], np.int16)
    for rows, cosines in _cosines(features, embeddings):
        labels.reshape(-1)[rows] = cosines.argmax(-1)
    return labels


def shares(features: np.ndarray, embeddings: np.ndarray) -> np.ndarray:
    """How likely each label is, f32 [..., L], rows of sum 1: the softmax that `decode` takes the largest entry of."""
    found = np.zeros((*features.shape[:-1], len(embeddings)), np.float32)
    for rows, cosines in _cosines(features, embeddings):
        weights = np.exp((cosines - cosines.max(-1, keepdims=True)) / TEMPERATURE)
        found.reshape(-1, len(embeddings))[rows] = weights / weights.sum(-1, keepdims=True)
    return found


def _cosines(features: np.ndarray, embeddings: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """(rows, their cosines [n, L]), BLOCK numbers at a time, so that thousands of labels do not cost gigabytes."""
    rows = features.reshape(-1, features.shape[-1])
    step = max(BLOCK // len(embeddings), 1)
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        lengths = np.linalg.norm(rows[part], axis=-1, keepdims=True).clip(1e-6)
        yield part, (rows[part] / lengths) @ embeddings.T
