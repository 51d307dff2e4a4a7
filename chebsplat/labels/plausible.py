"""Evidence, without true labels, that a teacher's labels of photos make sense: how much of them
outlives a change of a photo, where in the map such a change is seen, and whether what lies above is
called so.
"""

from __future__ import annotations

import numpy as np
from scipy.special import entr, rel_entr, softmax

SHARPNESS = 2.0  # of a softmax of values whose standard deviation is 1
ABOVE = frozenset(("ceiling", "sky"))
BELOW = frozenset((
    "carpet", "earth", "field", "floor", "grass", "ground", "path", "road", "rug", "sand",
    "sidewalk",
))  # fmt: skip
OUTDOORS = frozenset((
    "boat", "bridge", "building", "bus", "car", "earth", "fence", "field", "grass", "hill", "house",
    "mountain", "path", "river", "road", "rock", "sand", "sea", "sidewalk", "sky", "skyscraper",
    "snow", "tree", "truck", "water",
))  # fmt: skip
QUARTERS = ("top left", "top right", "bottom left", "bottom right")


def spread(values: np.ndarray) -> float:
    """Standard deviation of values [V, L, h, w] about their mean over the labels."""
    return float(np.std(values - values.mean(1, keepdims=True)))


def soft(values: np.ndarray, deviation: float) -> np.ndarray:
    """Shares [V, L, h, w] of labels: a softmax of values whose size does not matter."""
    shares: np.ndarray = softmax(values * (SHARPNESS / max(deviation, 1e-9)), axis=1)
    return shares


def information(first: np.ndarray, second: np.ndarray) -> float:
    """Mutual information, nats, of the labels that shares [V, L, h, w] of the same pixels give:
    none where all has one label, or where a label depends on how a photo was taken.
    """
    a, b = (
        np.moveaxis(shares, 1, 0).reshape(shares.shape[1], -1).astype(np.float64)
        for shares in (first, second)
    )
    joint = a @ b.T / a.shape[1]
    chance = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
    return float(rel_entr(joint, chance).sum())


def entropy(shares: np.ndarray) -> float:
    """Mean entropy, nats, of shares [V, L, h, w] in a pixel."""
    return float(entr(shares).sum(1).mean())


def changes(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Mean change of shares [V, L, h, w] in each of QUARTERS."""
    moved = np.abs(after - before).sum(1).mean(0)
    rows, columns = (np.array_split(np.arange(n), 2) for n in moved.shape)
    return np.array([moved[np.ix_(r, c)].mean() for r in rows for c in columns])


def sense(shares: np.ndarray, names: list[str], indoors: frozenset[str]) -> float:
    """Sense that the names make of shares [V, L, h, w] in photos of rooms, at most 2: what is
    called a floor lies below the middle and a ceiling above it (at most 1), and rooms hold what is
    seen rather than outdoors (at most 1).

    Args: names [L], as they are compared; indoors: words of rooms.
    Choices: a name counts by its words, so that "floor-wood" is a floor.
    """
    words = [frozenset(name.split()) for name in names]
    side = np.array([bool(of & BELOW) - bool(of & ABOVE) for of in words], float)
    place = np.array(
        [bool(of & indoors and not of & OUTDOORS) - bool(of & OUTDOORS) for of in words], float
    )
    height = (np.arange(shares.shape[2]) + 0.5) / shares.shape[2] - 0.5
    rows = shares.mean(3)  # [V, L, h]
    lies = 4 * np.einsum("vlh,l,h->v", rows, side, height) / shares.shape[2]
    return float(lies.mean() + (rows.mean(2) @ place).mean())
