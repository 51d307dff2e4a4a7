"""The encoder ignores padding and order, and fusion keeps what nothing covers."""

import numpy as np
import pytest
import torch

from chebsplat.labels.decode import VOCABULARY, class_codes, decode, decode_labels
from chebsplat.labels.noisy_teacher import confusable, confuse_segments, noisy_features, reduced
from chebsplat.settings import DescribeSection
from chebsplat.shape.encoder import RegionEncoder, Standardize
from chebsplat.shape.regions import regions_of
from chebsplat.splats.gaussians import activated, covariances, initial_gaussians, local_shape
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.training.facts import agreement
from chebsplat.training.model import SceneModel


def cloud(n=600, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 3))


def test_non_finite_points_are_refused():
    with pytest.raises(ValueError, match="finite"):
        regions_of(np.full((3, 3), np.nan), DescribeSection(n_regions=2, region_size=4))


@pytest.mark.parametrize("n_layers", [0, 2])
def test_encoding_ignores_padding_and_order(n_layers):
    torch.manual_seed(0)
    encoder = RegionEncoder(7, 5, n_layers=n_layers).eval()
    inputs, positions = torch.randn(3, 6, 7), torch.rand(3, 6, 3)
    plain = encoder(inputs, positions, torch.ones(3, 6, dtype=torch.bool))
    padded = torch.nn.functional.pad
    mask = torch.arange(10).expand(3, 10) < 6
    more = encoder(padded(inputs, (0, 0, 0, 4), value=3.0), padded(positions, (0, 0, 0, 4), value=9.0), mask)
    assert torch.allclose(plain, more, atol=1e-5)
    order = torch.randperm(6)
    assert torch.allclose(plain, encoder(inputs[:, order], positions[:, order], mask[:, :6]), atol=1e-5)


@pytest.mark.parametrize("n_layers", [0, 2])
def test_no_region_encodes_to_nothing_and_an_empty_one_to_something_finite(n_layers):
    encoder = RegionEncoder(5, 13, n_layers=n_layers)
    given = torch.zeros(1, 8, 5), torch.zeros(1, 8, 3), torch.zeros(1, 8, dtype=torch.bool)
    none, empty = encoder(*(part[:0] for part in given)), encoder(*given)
    none.sum().backward()
    assert none.shape == (0, 13)
    assert all(p.grad is None or p.grad.abs().max() == 0 for p in encoder.parameters())
    assert torch.isfinite(empty).all()


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="multiple"):
        RegionEncoder(3, 4, width=30, n_heads=4)


def test_initial_gaussians_reproduce_the_covariances_of_their_points():
    points = cloud() * (1.0, 1.0, 0.02)
    shapes, normals = local_shape(points, 16)
    raw = initial_gaussians(points, np.zeros((600, 3), np.uint8), shapes)
    _, quats, scales, _ = activated(raw)
    assert np.allclose(covariances(quats, scales).numpy(), shapes, atol=1e-5 * np.abs(shapes).max())
    assert np.median(np.abs(normals[:, 2])) > 0.8
    assert torch.isfinite(raw["log_scales"]).all()


def test_coincident_points_have_a_size():
    shapes, _ = local_shape(np.zeros((20, 3)), 8)
    assert (np.linalg.eigvalsh(shapes) > 0).all()


def test_code_vectors_are_a_function_of_the_name_and_lie_apart():
    codes = class_codes(list(VOCABULARY), 13)
    gram = codes @ codes.T - 2 * np.eye(len(codes))
    assert gram.max() < 0.35
    assert np.array_equal(class_codes(["sofa", "Tableware"], 13)[0], codes[VOCABULARY.index("sofa")])
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


def test_labels_are_told_in_parts_as_they_are_in_one():
    rng = np.random.default_rng(5)
    features, embeddings = rng.normal(size=(60, 80, 3)), rng.normal(size=(2000, 3))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    labels, confidence = decode(features, embeddings)
    cosines = features / np.linalg.norm(features, axis=-1, keepdims=True) @ embeddings.T
    assert np.array_equal(labels, cosines.argmax(-1))
    assert np.array_equal(labels, decode_labels(features, embeddings))
    assert np.allclose(confidence, 1 / np.exp((cosines - cosines.max(-1, keepdims=True)) / 0.1).sum(-1))


def test_inputs_are_standardised_and_outliers_bounded():
    norm = Standardize(3)
    norm.set(0, torch.tensor([100.0, -2.0]), torch.tensor([0.5, 0.0]))
    found = norm(torch.tensor([[101.0, -2.0, 0.25], [1e30, -2.0, -9.0]]))
    assert found.tolist() == [[2.0, 0.0, 0.25], [5.0, 0.0, -5.0]]


def two_shapes() -> tuple[SceneModel, torch.Tensor]:
    """A flat patch and a ball, far apart, each with features of its own; tokens hold descriptors alone."""
    generator, n = np.random.default_rng(0), 300
    flat, ball = generator.normal(size=(n, 3)) * [1, 1, 0.02], generator.normal(size=(n, 3))
    means = np.concatenate([flat, ball + np.array([20, 0, 0])])
    spread = np.concatenate([np.tile(np.diag([0.04, 0.04, 1e-5]), (n, 1, 1)), np.tile(np.eye(3) * 0.02, (n, 1, 1))])
    config = Config.model_validate(
        {"describe": {"n_regions": 60, "n_angles": 2}, "train": {"encoder": "transformer", "context": "none"}}
    )
    raw = initial_gaussians(means, np.full((2 * n, 3), 128, np.uint8), spread)
    model = SceneModel(raw, config.describe, config.train, 2)
    kind = (torch.arange(2 * n) >= n).long()
    with torch.no_grad():
        model.raw["features"].copy_(torch.eye(2)[kind])
    return model, kind


def test_the_encoder_learns_meaning_from_shape_and_leaves_the_features_alone():
    torch.manual_seed(0)
    model, kind = two_shapes()
    shape, features, generator = model.shape, model.raw["features"], torch.Generator().manual_seed(0)
    shape.refresh(model.raw)
    everyone, optimizer = torch.arange(len(kind)), torch.optim.Adam(shape.encoder.parameters(), lr=3e-3)
    seen = shape.descriptors[shape.members >= 0]
    assert shape.encoder.norm_input(seen).abs().max() <= 5
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        losses.append(shape.distance(features, shape.sample(features, everyone, generator)))
        losses[-1].backward()
        optimizer.step()
    assert losses[-1] < 0.2 * losses[0]
    assert features.grad is None
    shape.refresh(model.raw)
    assert (shape.cache.argmax(1) == kind[shape.centers]).float().mean() > 0.9  # of 60, some at an edge with 6 members
    found = agreement(shape.alone().numpy(), features.detach().numpy(), np.eye(2, dtype=np.float32))
    assert found["agreement"] > 0.97 and found["commonest"] == 0.5
