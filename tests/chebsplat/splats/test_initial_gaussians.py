"""Gaussians at points have the points' covariances, and a size where points coincide."""

import numpy as np
import torch

from chebsplat.splats.gaussians import activated, covariances, initial_gaussians, local_shape


def test_initial_gaussians_reproduce_the_covariances_of_their_points():
    points = np.random.default_rng(0).normal(size=(600, 3)) * (1.0, 1.0, 0.02)
    shapes, normals = local_shape(points, 16)
    raw = initial_gaussians(points, np.zeros((600, 3), np.uint8), shapes)
    _, quats, scales, _ = activated(raw)
    assert np.allclose(covariances(quats, scales).numpy(), shapes, atol=1e-5 * np.abs(shapes).max())
    assert np.median(np.abs(normals[:, 2])) > 0.8
    assert torch.isfinite(raw["log_scales"]).all()


def test_coincident_points_have_a_size():
    shapes, _ = local_shape(np.zeros((20, 3)), 8)
    assert (np.linalg.eigvalsh(shapes) > 0).all()
