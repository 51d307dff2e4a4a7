"""How relevant a place is to a query in words (LERF, section 3.3)."""

from __future__ import annotations

import numpy as np


def relevancy(features: np.ndarray, query: np.ndarray, against: np.ndarray, temperature: float = 0.1) -> np.ndarray:
    """Smallest, over the phrases it is weighed against, of the share that the query has of the two (LERF, section 3.3).

    Args:
      features:    [..., C] of any length.
      query:       [C] embedding of what is asked for; against: [K, C] of phrases that fit anything, K >= 1.
      temperature: of the softmax over a pair, > 0.
    Returns: f32 [...] in [0, 1]; above 0.5 where the query fits better than every one of the phrases.
    Raises:  ValueError on a shape that does not fit, or a temperature that is not positive.
    Choices: temperature 0.1, that of the labels' confidence, which the paper leaves to its code; features are made
      unit, embeddings are taken as they are, so that `channels` keeps the teacher's own inner products; a feature of
      length zero, of a place that no Gaussian covers, is relevant to nothing: 0.
    """
    n_channels = features.shape[-1]
    if query.shape != (n_channels,) or against.ndim != 2 or against.shape[1] != n_channels or not len(against):
        raise ValueError(f"features {features.shape}, query {query.shape} and phrases {against.shape} do not fit")
    if not temperature > 0:
        raise ValueError("temperature must be positive")
    lengths = np.linalg.norm(features, axis=-1)
    directions = features / lengths[..., None].clip(1e-6)
    margin = directions @ query - (directions @ against.T).max(-1)  # the strongest phrase gives the smallest share
    shares = 1 / (1 + np.exp(-margin.astype(np.float64) / temperature))
    return np.where(lengths > 0, shares, 0).astype(np.float32)
