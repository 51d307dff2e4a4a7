"""Unit code vectors of class names: one semantic space shared by all scenes, for teachers without text embeddings."""

from __future__ import annotations

import functools
import hashlib

import numpy as np

# Names met in indoor datasets; the codes of these repel one another, others are placed where room is left.
_NAMES = (
    "wall floor ceiling door window blinds desk table chair sofa cabinet shelf monitor keyboard lamp bin rug plant "
    "clock picture book cushion bed pillow blanket curtain counter refrigerator television toilet sink bathtub mirror "
    "shower stool bench box bag bottle vase basket stove oven microwave dishwasher faucet fan radiator stairs pillar "
    "tv-screen nightstand armchair wardrobe towel bowl plate cup screen switch vent painting"
)
VOCABULARY = tuple(_NAMES.split())


def class_codes(names: list[str], n_channels: int) -> np.ndarray:
    """Unit vectors [L, n_channels] float32, a function of each name alone.

    Raises: ValueError if a name repeats or n_channels < 2.
    """
    if len(set(names)) != len(names):
        raise ValueError("class names repeat")
    if n_channels < 2:
        raise ValueError("n_channels must be at least 2")
    frame = _frame(n_channels)
    known = dict(zip(VOCABULARY, frame, strict=True))
    rows = [known[name] if name in known else _placed(name, frame) for name in names]
    return np.asarray(rows, np.float32).reshape(len(names), n_channels)


def _placed(name: str, frame: np.ndarray) -> np.ndarray:
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
