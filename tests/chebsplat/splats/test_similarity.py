"""Points, cameras and Gaussians in another frame look as they did."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from shared import gaussian_parameters

from chebsplat.render import SceneRenderer
from chebsplat.splats.similarity import Similarity, fitted
from chebsplat.views import View

WAY = Similarity(
    2.7, Rotation.from_rotvec([1.0, -2.0, 0.3]).as_matrix(), np.array([3.0, -5.0, 11.0])
)


def image(parameters, pose):
    K = torch.tensor([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])
    return (
        SceneRenderer(parameters)
        .render(View(K, torch.from_numpy(pose).float(), 64, 48))[0]
        .astype(int)
    )


@pytest.mark.parametrize("seed", range(3))
def test_gaussians_with_all_bands_look_the_same_from_the_moved_camera(seed):
    parameters = gaussian_parameters(40, seed)
    parameters["log_scales"] -= 1.5
    pose = np.eye(4)
    pose[:3, 3] = [0.2, 0.1, 4]
    before = image(parameters, pose)
    after = image(WAY.of_gaussians(parameters), WAY.of_cameras(pose[None])[0])
    assert np.abs(before - after).max() <= 2 and before.std() > 10  # steps of 255; single precision


def test_a_way_there_and_back_and_two_in_a_row():
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(WAY.inverse().of_points(WAY.of_points(points)), points, atol=1e-12)
    np.testing.assert_allclose(
        WAY.after(WAY).of_points(points), WAY.of_points(WAY.of_points(points)), atol=1e-12
    )


def test_the_way_between_points_is_found_of_a_mirrored_cloud_without_a_mirror():
    points = np.random.default_rng(0).normal(size=(50, 3))
    for found, wanted in zip(fitted(points, WAY.of_points(points)), WAY, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-10)
    assert np.linalg.det(fitted(points, points * [1, 1, -1]).rotation) == pytest.approx(1)
