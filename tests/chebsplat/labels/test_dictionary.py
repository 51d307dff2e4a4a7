"""Many Gaussians share few features, and mean what they meant."""

import numpy as np
import pytest

from chebsplat.labels.decode import decode_labels
from chebsplat.labels.dictionary import shared_features


def around(words, n, spread, seed=0):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, len(words), n)
    features = words[labels] + spread * rng.normal(size=(n, words.shape[1]))
    return features.astype(np.float32), labels


@pytest.mark.parametrize("length", [1e-30, 1.0, 1e30])
def test_gaussians_share_few_features_and_keep_their_labels(length):
    words = np.linalg.qr(np.random.default_rng(1).normal(size=(16, 16)))[0][:8]
    features, labels = around(words, 5000, 0.05)
    features[::50] = 0
    shared = shared_features(features * np.float32(length), (40,))
    assert len(np.unique(shared[features.any(1)], axis=0)) <= 40
    assert not shared[::50].any()
    known = features.any(1)
    assert (decode_labels(shared[known] / np.float32(length), words) == labels[known]).mean() > 0.99
    error = np.linalg.norm(shared / np.float32(length) - features, axis=1)[known]
    assert error.mean() < 0.05 * np.sqrt(16)  # no farther than the features are from their word


def test_few_features_stay_as_they_are():
    features = around(np.eye(8), 40, 0.05)[0]
    assert np.array_equal(shared_features(features, (40, 80)), features)


@pytest.mark.parametrize(("spread", "rows"), [(0.01, 8), (0.07, 32), (0.5, 64)])
def test_features_that_differ_more_get_more_rows(spread, rows):
    """Around eight words of length 1, by a spread a channel: 6 % of error are asked for."""
    features = np.concatenate([np.eye(8)] * 300).astype(np.float32)
    features[:, :2] += spread * np.random.default_rng(0).normal(size=(len(features), 2))
    shared = shared_features(features, (8, 16, 32, 64))
    assert len(np.unique(shared, axis=0)) == rows
