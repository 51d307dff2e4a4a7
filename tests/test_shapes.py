"""The shapes benchmark draws what it says, fits without the test split, and writes down what it prints."""

import csv

import numpy as np
import pytest
from shared import ROOT


@pytest.fixture
def shapes(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import benchmarks.shapes.main as module

    return module


@pytest.mark.parametrize("shape", ["plane", "edge", "corner", "cylinder", "sphere", "rod", "wave", "saddle"])
def test_normals_are_unit_and_perpendicular_to_the_surface(shapes, shape):
    means, normals = shapes.samples.surface(shape, 4000, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    distance = np.linalg.norm(means[:, None, :] - means[:200], axis=-1)
    distance[np.arange(200), np.arange(200)] = np.inf
    nearest = distance.argmin(0)
    step = means[nearest] - means[:200]
    height = np.abs((step * normals[:200]).sum(1)) / np.linalg.norm(step, axis=1)
    assert np.median(height) < 0.1  # a curve leaves its tangent plane by step / (2 radius)


def test_gaussians_carry_right_handed_frames_with_the_normal_last(shapes):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    R = shapes.samples.frames(normals, rng)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    np.testing.assert_allclose(R[:, :, 2], normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=1e-12)
    regions = shapes.samples.sample(shapes.CLEAN._replace(n=40), 2, rng)
    assert regions.means.shape == (16, 40, 3)
    assert (regions.scales[..., 2] < regions.scales[..., :2].min(-1)).all()
    assert np.bincount(regions.labels).tolist() == [2] * 8


@pytest.mark.parametrize("kind", ["linear", "knn"])
def test_classifiers_learn_what_is_there_and_nothing_else(shapes, kind):
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), 60)
    blobs, noise = rng.normal(size=(180, 4)) + 6 * np.eye(4)[labels], rng.normal(size=(180, 4))
    fit, accuracy = shapes.classifiers.fit, shapes.classifiers.accuracy
    assert accuracy(fit(kind, blobs[::2], labels[::2], rng), blobs[1::2], labels[1::2]) > 97
    assert accuracy(fit(kind, noise[::2], labels[::2], rng), noise[1::2], labels[1::2]) < 60


def test_a_column_that_is_constant_in_training_says_nothing(shapes):
    rng = np.random.default_rng(0)
    constant, rounding = 0.1 + 1e-16 * rng.normal(size=60), 1e-17 * rng.normal(size=60)
    x = np.column_stack([rng.normal(size=(60, 2)), constant, rounding])
    standard = shapes.classifiers.standardizer(x)
    assert (standard(x + 5)[:, 2:] == 0).all()
    np.testing.assert_allclose(standard(x)[:, :2].std(0), 1)


@pytest.mark.parametrize("pooling", ["mean and deviation", "quartiles"])
def test_features_ignore_pose_place_size_and_order(shapes, pooling):
    rng = np.random.default_rng(3)
    regions = shapes.samples.sample(shapes.CLEAN, 1, rng)
    turn, order = shapes.samples.frames(np.ones((1, 3)), rng)[0], rng.permutation(64)
    moved = regions._replace(means=3 * (regions.means @ turn.T)[:, order] + 1, scales=3 * regions.scales[:, order],
                             rotmats=(turn @ regions.rotmats)[:, order])  # fmt: skip
    for name in ("ours", "isotropic", "no rotations", "eigenvalues", "Gaussian moments"):
        a, b = (shapes.pooled(shapes.FEATURES[name](r), pooling) for r in (regions, moved))
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3 * np.abs(a).max(), err_msg=name)


def test_a_small_run_prints_and_writes_the_same_accuracies(shapes, tmp_path, capsys):
    names = ["ours", "no rotations", "FPFH, Gaussian normals", "Gaussian moments", "ours + moments"]
    sizes = ["--seeds", "1", "--train", "8", "--test", "2"]
    assert shapes.main([*sizes, "--features", *names, "--out", str(tmp_path)]) == 0
    with (tmp_path / "shapes.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == len(names) * 2 * len(shapes.CONDITIONS)
    assert all(0 <= float(row["accuracy"]) <= 100 for row in rows)
    printed = capsys.readouterr().out
    clean = next(r for r in rows if r["feature"] == "ours" and r["condition"] == "as trained")
    assert f"{float(clean['accuracy']):5.1f} ± 0.0" in printed
    assert float(clean["accuracy"]) > 60
    assert "points, bar 12" in printed
    assert (tmp_path / "shapes.png").stat().st_size > 10_000
