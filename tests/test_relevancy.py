"""Relevancy is a share: it grows with the query's cosine, falls with the strongest rival's, and knows no lengths."""

import numpy as np
import pytest

from chebsplat.labels.relevancy import relevancy


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.fixture
def sample():
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 5)), unit(rng.normal(size=5)), unit(rng.normal(size=(4, 5)))


def test_relevancy_is_the_smallest_pairwise_softmax_share(sample):
    features, query, against = sample
    cosines, rivals = unit(features) @ query, unit(features) @ against.T
    shares = np.exp(cosines / 0.1)[:, None] / (np.exp(cosines / 0.1)[:, None] + np.exp(rivals / 0.1))
    found = relevancy(features, query, against)
    assert found.dtype == np.float32
    assert np.allclose(found, shares.min(1), atol=1e-6)
    assert found.min() >= 0 and found.max() <= 1


def test_relevancy_ignores_the_length_of_features(sample):
    features, query, against = sample
    longer = features * np.logspace(-3, 3, len(features))[:, None]
    assert np.allclose(relevancy(features, query, against), relevancy(longer, query, against), atol=1e-6)


def test_turning_towards_the_query_never_lowers_relevancy():
    query, rival = np.eye(2)
    angles = np.linspace(np.pi / 2, 0, 50)
    found = relevancy(np.stack([np.cos(angles), np.sin(angles)], 1), query, rival[None])
    assert np.all(np.diff(found) > 0)
    assert found[0] < 0.01 and found[-1] > 0.99


def test_one_more_phrase_never_raises_relevancy(sample):
    features, query, against = sample
    assert np.all(relevancy(features, query, against) <= relevancy(features, query, against[:2]))


def test_a_query_equal_to_its_only_rival_is_half_relevant_everywhere(sample):
    features, query, _ = sample
    assert np.allclose(relevancy(features, query, query[None]), 0.5)


def test_a_place_without_features_is_relevant_to_nothing(sample):
    _, query, against = sample
    found = relevancy(np.zeros((2, 3, 5)), query, against)
    assert found.shape == (2, 3)
    assert not found.any()


@pytest.mark.parametrize(
    ("query", "against", "temperature"),
    [(np.ones(4), np.ones((2, 5)), 0.1), (np.ones(5), np.ones((0, 5)), 0.1), (np.ones(5), np.ones(5), 0.1),
     (np.ones(5), np.ones((2, 5)), 0.0)],
)  # fmt: skip
def test_what_does_not_fit_is_an_error(query, against, temperature):
    with pytest.raises(ValueError, match=r"fit|positive"):
        relevancy(np.ones((3, 5)), query, against, temperature)
