"""Relevancy is the share that a query has beside its strongest rival, and knows no lengths."""

import numpy as np
import pytest

from chebsplat.labels.calibration import relevancy


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.fixture
def sample():
    rng = np.random.default_rng(3)
    features = rng.normal(size=(40, 5)) * np.logspace(-3, 3, 40)[:, None]
    return features, unit(rng.normal(size=5)), unit(rng.normal(size=(4, 5)))


def test_relevancy_is_the_smallest_pairwise_softmax_share(sample):
    features, query, against = sample
    cosines, rivals = unit(features) @ query, unit(features) @ against.T
    shares = np.exp(cosines / 0.1)[:, None] / (
        np.exp(cosines / 0.1)[:, None] + np.exp(rivals / 0.1)
    )
    found = relevancy(features, query, against)
    assert found.dtype == np.float32
    assert np.allclose(found, shares.min(1), atol=1e-6)
    assert found.min() >= 0 and found.max() <= 1


def test_a_place_without_features_is_relevant_to_nothing(sample):
    _, query, against = sample
    found = relevancy(np.zeros((2, 3, 5)), query, against)
    assert found.shape == (2, 3)
    assert not found.any()


@pytest.mark.parametrize(
    ("query", "against", "temperature"),
    [(np.ones(4), np.ones((2, 5)), 0.1), (np.ones(5), np.ones((0, 5)), 0.1),
     (np.ones(5), np.ones(5), 0.1),
     (np.ones(5), np.ones((2, 5)), 0.0)],
)  # fmt: skip
def test_what_does_not_fit_is_an_error(query, against, temperature):
    with pytest.raises(ValueError, match=r"fit|positive"):
        relevancy(np.ones((3, 5)), query, against, temperature)
