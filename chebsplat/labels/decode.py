"""Labels and features: the label whose embedding has the largest cosine; votes of pseudo labels;
codes of class names.

Class codes are unit vectors of names, one space for all scenes, for teachers without text
embeddings.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator

import numpy as np

TEMPERATURE = 0.1  # of cosines
BLOCK = 4_000_000  # cosines in memory at once
IGNORE = -1
# Names in indoor datasets; their codes repel one another, those of other names lie between them.
_NAMES = (
    "wall floor ceiling door window blinds desk table chair sofa cabinet shelf monitor keyboard "
    "lamp bin rug plant clock picture book cushion bed pillow blanket curtain counter "
    "refrigerator television toilet sink bathtub mirror shower stool bench box bag bottle vase "
    "basket stove oven microwave dishwasher faucet fan radiator stairs pillar tv-screen "
    "nightstand armchair wardrobe towel bowl plate cup screen switch vent painting"
)
VOCABULARY = tuple(_NAMES.split())


def decode(features: np.ndarray, embeddings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Label of the largest cosine, and its confidence.

    Args: features [..., C] of any length; embeddings [L, C] unit, or what `channels` keeps of them.
    Returns: labels i16 [...], confidence f32 [...]: softmax of cosines at temperature 0.1, its
      largest entry.
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


def shares(
    features: np.ndarray, embeddings: np.ndarray, temperature: float = TEMPERATURE
) -> np.ndarray:
    """Probability of each label, f32 [..., L], of sum 1: a softmax; `decode` takes its maximum."""
    probabilities = np.zeros((*features.shape[:-1], len(embeddings)), np.float32)
    for rows, cosines in _cosines(features, embeddings):
        weights = np.exp((cosines - cosines.max(-1, keepdims=True)) / temperature)
        probabilities.reshape(-1, len(embeddings))[rows] = weights / weights.sum(-1, keepdims=True)
    return probabilities


def _cosines(features: np.ndarray, embeddings: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """(rows, their cosines [n, L]), BLOCK numbers at a time, so that many labels fit in memory."""
    rows = features.reshape(-1, features.shape[-1])
    step = max(BLOCK // len(embeddings), 1)
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        lengths = np.linalg.norm(rows[part], axis=-1, keepdims=True).clip(1e-6)
        yield part, (rows[part] / lengths) @ embeddings.T


def voted(
    labels: np.ndarray, confidence: np.ndarray, class_codes: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of cells of factor x factor pixels, in which every pixel votes for its label as much
    as it is sure.

    Args: labels i16 [H, W], IGNORE none; confidence [H, W] in [0, 1]; class_codes [L, C] unit.
    Returns: features f32 [h, w, C]: the unit mean of the class codes by votes, zero without a vote;
      labels i16 [h, w] with the most votes, IGNORE without any; confidence f32 [h, w]: the votes
      for it by pixel.
    Choices: a cell at the right or lower edge has fewer pixels. Confidences decide what a cell of
      several labels is taught, and weigh it in the loss (`training.losses.semantic_loss`); a cell
      without any is taught nothing.
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


def class_codes(names: list[str], n_channels: int) -> np.ndarray:
    """Unit vectors [L, n_channels] float32, a function of each name alone.

    Raises: ValueError if a name repeats or n_channels < 2.
    """
    if len(set(names)) != len(names):
        raise ValueError("class names repeat")
    if n_channels < 2:
        raise ValueError("n_channels must be at least 2")
    frame = _frame(n_channels)
    code_of = dict(zip(VOCABULARY, frame, strict=True))
    rows = [code_of[name] if name in code_of else _draw_code(name, frame) for name in names]
    return np.asarray(rows, np.float32).reshape(len(names), n_channels)


def _draw_code(name: str, frame: np.ndarray) -> np.ndarray:
    """Of 512 vectors drawn from the name's hash, the one least like any of the vocabulary."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    drawn = _unit(np.random.default_rng(seed).normal(size=(512, frame.shape[1])))
    loneliest: np.ndarray = drawn[np.argmin((drawn @ frame.T).max(1))]
    return loneliest


@functools.cache
def _frame(n_channels: int) -> np.ndarray:
    """Vectors of the vocabulary, pushed apart: 200 steps down a steep repulsive energy."""
    vectors = _unit(np.random.default_rng(7).normal(size=(len(VOCABULARY), n_channels)))
    for step in range(200):
        weights = np.exp(12 * (vectors @ vectors.T))
        np.fill_diagonal(weights, 0)
        push = (weights / weights.sum(1, keepdims=True)) @ vectors
        vectors = _unit(vectors - (0.3 - 0.001 * step) * push)
    return vectors


def _unit(rows: np.ndarray) -> np.ndarray:
    unit: np.ndarray = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return unit
