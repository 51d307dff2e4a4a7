"""What a teacher has no label for pulls nothing, and what it is unsure of pulls less."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.stability.training import CHANNELS, four_views, tiny_trainer
from chebsplat.errors import ConfigError
from chebsplat.formats.features import Features
from chebsplat.labels.noisy_teacher import IGNORE, noisy_features
from chebsplat.settings import TrainSection
from chebsplat.stages.training.defaults import evidence_of, resolved
from chebsplat.training.losses import label_entropy, semantic_loss
from chebsplat.views import TaughtLabels

H, W, C, L = 8, 12, 5, 3


def view(dtype=torch.float64, seed=0):
    """A render [H, W, C] with a gradient, and labels of 4 x 6 cells, one of which has none."""
    g = torch.Generator().manual_seed(seed)
    render = torch.randn(H, W, C, generator=g, dtype=dtype).requires_grad_(True)
    index = torch.randint(L, (4, 6), generator=g)
    index[1, 2] = -1
    confidence = torch.rand(4, 6, generator=g) * (index >= 0)
    return render, TaughtLabels(index, confidence, torch.randn(L, C, generator=g))


def gradient(loss, render):
    (found,) = torch.autograd.grad(loss, render)
    return found


def test_label_entropy_is_its_formula():
    render, labels = view()
    total = 0.0
    for i in range(4):
        for j in range(6):
            if labels.classes[i, j] >= 0:
                mean = (
                    render[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                    .reshape(-1, C)
                    .mean(0)
                    .detach()
                    .numpy()
                )
                logits = labels.class_codes.double().numpy() @ mean / 0.3
                likelihood = math.exp(logits[labels.classes[i, j]]) / np.exp(logits).sum()
                total -= float(labels.confidence[i, j].double()) * math.log(likelihood)
    assert abs(label_entropy(render, labels, None, 0.3).item() - total / 23) < 1e-12


@pytest.mark.parametrize("kind", ["cross-entropy", "length", "l1", None])
def test_a_cell_without_a_label_pulls_nothing_whatever_the_loss(kind):
    render, labels = view(torch.float32)
    features = torch.zeros(4, 6, C)
    settings = TrainSection(feature_loss=kind)
    found = gradient(semantic_loss(render, features, labels, None, settings), render)
    assert (found[2:4, 4:6] == 0).all()
    assert (found[:2] != 0).any(-1).all()
    none = labels._replace(classes=torch.full((4, 6), -1))
    loss = semantic_loss(render, features, none, None, settings)
    assert loss.item() == 0
    assert (gradient(loss, render) == 0).all()


def test_masked_pixels_do_not_count_and_nothing_left_is_no_loss():
    render, labels = view()
    mask = torch.ones(H, W, dtype=torch.bool)
    mask[:, :4] = False
    assert (gradient(label_entropy(render, labels, mask, 1.0), render)[:, :4] == 0).all()
    assert label_entropy(render, labels, torch.zeros_like(mask), 1.0).item() == 0


def test_where_every_cell_has_a_label_distances_are_as_without():
    render, labels = view(torch.float32)
    every = labels._replace(classes=labels.classes.clamp_min(0))
    features, settings = torch.randn(4, 6, C), TrainSection()
    assert torch.equal(
        *(semantic_loss(render, features, given, None, settings) for given in (every, None))
    )


def stored(kind, with_labels=True):
    values = np.zeros((1, 2, 2, C), np.float16)
    labels = (
        (np.zeros((1, 2, 2), np.int16), np.ones((1, 2, 2), np.float16))
        if with_labels
        else (None, None)
    )
    return Features(
        ["a"], values, ["wall"], np.eye(1, C, dtype=np.float32), *labels, convention={"kind": kind}
    )


def decided(train, features):
    """The section resolved for these features."""
    capture = SimpleNamespace(
        names=["a"], is_test=np.zeros(1, bool), size=(1, 1), depth=None, cam_from_world=None
    )
    points = SimpleNamespace(names=["a"], notes={}, depths=None)
    return resolved(train, evidence_of(train, capture, points, features))


def test_labels_that_a_source_brings_are_learned_by_cross_entropy_unless_told_otherwise():
    assert decided(TrainSection(), stored("given")).feature_loss == "cross-entropy"
    assert decided(TrainSection(), stored("labels")).feature_loss == "length"
    assert decided(TrainSection(feature_loss="l1"), stored("given")).feature_loss == "l1"
    asked = TrainSection(feature_loss="cross-entropy")
    assert decided(asked, stored("labels")).feature_loss == "cross-entropy"
    with pytest.raises(ConfigError, match="no labels with a confidence"):
        decided(asked, stored("onnx", with_labels=False))
    with pytest.raises(ValueError, match="labels"):
        semantic_loss(torch.zeros(2, 2, C), torch.zeros(2, 2, C), None, None, asked)


def test_ignored_pixels_of_the_labels_teacher_are_zero_not_noise():
    labels = np.array([[0, IGNORE], [1, 1]])
    features = noisy_features(labels, np.eye(2, 4), 1.0, 0.5, np.random.default_rng(0))
    assert (features[0, 1] == 0).all()
    assert np.allclose(np.linalg.norm(features[labels != IGNORE], axis=-1), 1)


def test_a_training_of_labels_runs_to_a_finite_end():
    views = four_views()
    g = torch.Generator().manual_seed(0)
    index, codes = (
        torch.randint(-1, L, (10, 12), generator=g),
        torch.randn(L, CHANNELS, generator=g),
    )
    confidence = torch.rand(10, 12, generator=g)
    views.labels = lambda _: TaughtLabels(index, confidence, codes)
    trainer = tiny_trainer(views=views, feature_loss="cross-entropy")
    figures = list(trainer.steps())
    assert all(math.isfinite(value) for row in figures for value in row.values())
    assert figures[-1]["n"] != figures[0]["n"]
    assert all(np.isfinite(value).all() for value in trainer.finish().values())
