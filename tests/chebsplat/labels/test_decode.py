"""Codes of names lie apart, labels decode from them, and noise confuses as many segments as it is
told to.
"""

import numpy as np

from chebsplat.labels.decode import VOCABULARY, class_codes, decode, decode_labels
from chebsplat.labels.noisy_teacher import confusable, confuse_segments, noisy_features, reduced


def test_code_vectors_are_a_function_of_the_name_and_lie_apart():
    codes = class_codes(list(VOCABULARY), 13)
    gram = codes @ codes.T - 2 * np.eye(len(codes))
    assert gram.max() < 0.35
    assert np.array_equal(
        class_codes(["sofa", "Tableware"], 13)[0], codes[VOCABULARY.index("sofa")]
    )
    assert np.array_equal(class_codes(["Tableware"], 13), class_codes(["x", "Tableware"], 13)[1:])


def test_reduced_labels_are_the_commonest():
    labels = np.array([[0, 0, 1], [0, 2, 1], [5, 5, 5]])
    assert reduced(labels, 2).tolist() == [[0, 1], [5, 5]]


def test_confusion_rate_is_p_by_segment_and_keeps_ignored_pixels():
    labels = np.indices((60, 60)).sum(0) % 2  # every pixel is its own 4-connected segment
    labels[0] = -1
    p = confusable(np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.9, 0, 0]]))
    found = confuse_segments(labels, p, 0.3, np.random.default_rng(0))
    assert abs((found[1:] != labels[1:]).mean() - 0.3) < 0.03
    assert (found[0] == -1).all()
    assert (found == 2).sum() < (found != labels).sum() * 0.05
    assert np.array_equal(confuse_segments(labels, p, 0.0, np.random.default_rng(0)), labels)


def test_a_class_that_does_not_occur_is_never_taken():
    colors = np.array([[0.1, 0.1, 0.1], [np.nan] * 3, [0.2, 0.2, 0.2]])
    assert (confusable(colors)[:, 1] == 0).all()
    assert confusable(colors[:1]).tolist() == [[0.0]]


def test_noise_free_features_decode_to_their_labels():
    codes = class_codes(["wall", "floor", "sofa"], 13)
    labels = np.random.default_rng(0).integers(0, 3, (8, 9))
    features = noisy_features(labels, codes, 0.0, 0.0, np.random.default_rng(0))
    found, confidence = decode(features, codes)
    assert np.array_equal(found, labels)
    assert (confidence > 0.9).all()


def test_blurred_features_at_an_edge_hold_the_codes_of_both_sides():
    labels = np.repeat([[0] * 9 + [1] * 9], 9, 0)
    features = noisy_features(labels, np.eye(2, 4), 1.0, 0.0, np.random.default_rng(0))
    other = (
        0.5 - 0.5 / np.exp(-0.5 * np.arange(-4, 5) ** 2).sum()
    )  # of a Gaussian beyond its middle
    assert np.allclose(features[:, 8, 1] / features[:, 8, 0], other / (1 - other), rtol=1e-3)


def test_labels_are_told_in_parts_as_they_are_in_one():
    rng = np.random.default_rng(5)
    features, embeddings = rng.normal(size=(60, 80, 3)), rng.normal(size=(2000, 3))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    labels, confidence = decode(features, embeddings)
    cosines = features / np.linalg.norm(features, axis=-1, keepdims=True) @ embeddings.T
    assert np.array_equal(labels, cosines.argmax(-1))
    assert np.array_equal(labels, decode_labels(features, embeddings))
    assert np.allclose(
        confidence, 1 / np.exp((cosines - cosines.max(-1, keepdims=True)) / 0.1).sum(-1)
    )
