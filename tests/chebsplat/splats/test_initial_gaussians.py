"""Gaussians at points have the points' shapes and colours, and a size where points coincide."""

import numpy as np
from scipy.spatial.transform import Rotation

from chebsplat.splats.gaussians import activated, covariances, initial_gaussians, local_shape


def test_gaussians_of_a_sheet_lie_in_it_as_large_as_points_are_apart_and_a_twentieth_thick():
    rng, turn = np.random.default_rng(0), Rotation.from_rotvec([1.0, -2.0, 0.3]).as_matrix()
    points = rng.normal(size=(600, 3)) * (1.0, 1.0, 0.0) @ turn.T
    shapes, normals = local_shape(points, 16)
    colors = rng.integers(0, 256, (600, 3)).astype(np.uint8)
    raw = initial_gaussians(points, colors, shapes, opacity=0.3)
    _, quats, scales, opacities = activated(raw)
    assert np.allclose(covariances(quats, scales).numpy(), shapes, atol=1e-5 * np.abs(shapes).max())
    assert np.allclose(np.abs(normals @ turn[:, 2]), 1, atol=1e-6)
    apart = np.sort(np.linalg.norm(points[:, None] - points, axis=-1), axis=1)[:, 1:4]
    spacing = np.sqrt((apart**2).mean(1))
    assert np.allclose(scales.numpy().max(1), spacing, rtol=1e-4)
    assert np.allclose(scales.numpy().min(1), 0.05 * spacing, rtol=1e-3)
    assert np.allclose(opacities, 0.3)
    assert np.allclose(
        255 * (0.5 + 0.28209479177387814 * raw["sh0"][:, 0].numpy()), colors, atol=1e-3
    )


def test_coincident_points_have_a_size():
    shapes, _ = local_shape(np.zeros((20, 3)), 8)
    assert (np.linalg.eigvalsh(shapes) > 0).all()
