"""The noisy-labels teacher: 2D labels of known error, for studies (docs/method.md, section 9)."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, label

IGNORE = -1


def class_colors(images: np.ndarray, labels: np.ndarray, n_classes: int) -> np.ndarray:
    """Mean colour [L, 3] in [0, 1] of each class; nan for a class that does not occur."""
    labelled = labels != IGNORE
    flat = labels[labelled].astype(np.int64)
    counts = np.bincount(flat, minlength=n_classes)
    sums = np.stack(
        [np.bincount(flat, images[..., c][labelled] / 255.0, n_classes) for c in range(3)], 1
    )
    return np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], np.nan)


def confusable(colors: np.ndarray, width: float = 0.15) -> np.ndarray:
    """Probability [L, L] that a class is taken for another of like colour; rows sum to 1 or 0.

    Choices: a Gaussian of the colour distance, `width` in units of full intensity, plus 1e-6 so
      that every class that occurs can be confused with another.
    """
    distance = np.linalg.norm(colors[:, None] - colors[None], axis=-1)
    weights = np.where(np.isfinite(distance), np.exp(-0.5 * (distance / width) ** 2) + 1e-6, 0.0)
    np.fill_diagonal(weights, 0)
    totals = weights.sum(1, keepdims=True)
    probabilities: np.ndarray = np.divide(
        weights, totals, out=np.zeros_like(weights), where=totals > 0
    )
    return probabilities


def reduced(labels: np.ndarray, factor: int) -> np.ndarray:
    """Labels [H, W] at 1/factor: the commonest label of each cell, the smaller one on a tie."""
    height, width = (-(-n // factor) for n in labels.shape)
    padded = np.pad(
        labels,
        ((0, height * factor - labels.shape[0]), (0, width * factor - labels.shape[1])),
        "edge",
    )
    cells = (
        padded.reshape(height, factor, width, factor)
        .transpose(0, 2, 1, 3)
        .reshape(height, width, -1)
    )
    votes = (cells[..., None] == cells[..., None, :]).sum(-1)
    order = votes.astype(np.int64) * 100_000 - cells
    return np.take_along_axis(cells, order.argmax(-1)[..., None], -1)[..., 0]


def confuse_segments(
    labels: np.ndarray, probabilities: np.ndarray, p: float, generator: np.random.Generator
) -> np.ndarray:
    """With probability p, a connected segment (4-neighbours) of this view takes a confusable class.

    Args: labels [h, w], IGNORE stays; probabilities [L, L] rows sum to 1, or to 0 for a class that
      is never taken for another.
    """
    confused = labels.copy()
    for value in np.unique(labels[labels != IGNORE]):
        segments, count = label(labels == value)
        swapped = generator.random(count) < p
        if probabilities[value].sum() > 0:
            others = generator.choice(len(probabilities), count, p=probabilities[value])
            pixels = np.concatenate([[False], swapped])[segments]
            confused[pixels] = np.concatenate([[0], others])[segments][pixels]
    return confused


def noisy_features(
    labels: np.ndarray,
    class_codes: np.ndarray,
    blur: float,
    noise: float,
    generator: np.random.Generator,
) -> np.ndarray:
    """Unit features [h, w, C]: codes of labels, blurred over boundaries, with Gaussian noise.

    Args: labels [h, w], class_codes [L, C] unit; blur: sigma in feature pixels; noise: deviation a
      channel.
    Returns: zero at ignored pixels, which teach nothing.
    Choices: ignored pixels hold the zero vector before blur; normalised at the end.
    """
    features = np.where((labels != IGNORE)[..., None], class_codes[labels], 0.0)
    if blur > 0:
        features = gaussian_filter(features, (blur, blur, 0))
    features = features + generator.normal(0, noise, features.shape)
    unit = features / np.linalg.norm(features, axis=-1, keepdims=True).clip(1e-6)
    masked: np.ndarray = np.where((labels != IGNORE)[..., None], unit, 0.0)
    return masked
