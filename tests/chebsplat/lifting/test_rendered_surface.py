"""Rendered depth lies on the planes that Gaussians are, wherever they are looked at from."""

import numpy as np
import pytest
import torch

from chebsplat.cameras import centers, common_up, upright
from chebsplat.lifting.surface import EDGE, EDGE_SWEPT, fused, lookouts, surface, swept_surface
from chebsplat.splats.planes import GRAZING, inverse_depths, planes_in_view
from chebsplat.splats.rotations import rotation_matrices
from chebsplat.synthetic.rays import intrinsics, look_at

SIZE = 96, 72
K = intrinsics(*SIZE)


def tiles(normal, middle, spacing=0.1, half=8):
    """Flat Gaussians that tile a plane: raw parameters."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first), normal], 1)
    a, b = np.meshgrid(*[spacing * np.arange(-half, half + 1)] * 2)
    means = np.asarray(middle) + np.stack([a.ravel(), b.ravel(), 0 * a.ravel()], 1) @ axes.T
    from scipy.spatial.transform import Rotation

    n, quat = len(means), Rotation.from_matrix(axes).as_quat(scalar_first=True)
    scales = np.log([0.7 * spacing, 0.7 * spacing, 1e-3])
    raw = {"means": means, "quats": np.tile(quat, (n, 1)), "log_scales": np.tile(scales, (n, 1))}
    raw |= {"logit_opacities": np.full(n, 4.0), "sh0": np.zeros((n, 1, 3))}
    return {name: values.astype(np.float32) for name, values in raw.items()}, normal


@pytest.mark.parametrize("unit", [1.0, 30.0])
@pytest.mark.parametrize("normal", [(0, 0, 1.0), (1.0, 0.2, 0.3)])
def test_points_lie_on_the_plane_that_tilted_gaussians_tile(normal, unit):
    raw, normal = tiles(normal, (0.2, -0.1, 0.5))
    raw["means"] *= unit
    raw["log_scales"] += np.float32(np.log(unit))
    middle = unit * np.array([0.2, -0.1, 0.5])
    poses = np.stack(
        [
            look_at(middle + unit * (1.2 * normal + offset), middle)
            for offset in ((0.5, 0.1, 0), (0, 0.6, 0.2))
        ]
    )
    found = surface(raw, poses, np.stack([K, K]), SIZE, unit)
    assert len(found.means) > 200
    assert np.abs((found.means - middle) @ normal).max() < 0.01 * unit
    assert (np.linalg.norm(found.eyes - middle, axis=1) < 2 * unit).all()


def test_a_plane_s_inverse_depth_is_linear_in_pixels():
    rng = np.random.default_rng(0)
    means, normals = rng.normal((0, 0, 3), 0.3, (50, 3)), rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = inverse_depths(*map(torch.from_numpy, (means, normals, K)), 0.05).numpy()
    for mean, normal, plane in zip(means, normals, planes, strict=True):
        pixel = np.array([40.0, 30.0, 1.0])
        ray = np.linalg.inv(K) @ pixel
        # the rest faces the camera
        share = min(abs(normal @ mean) / (0.15 * np.linalg.norm(mean)), 1) ** 2
        inverse = share * (normal @ ray) / (normal @ mean) + (1 - share) / mean[2]
        assert plane @ pixel == pytest.approx(inverse, rel=1e-9)


def test_planes_in_view_have_the_gradient_of_what_they_are():
    """Some are seen at a grazing angle; quaternions of any length."""
    g = torch.Generator().manual_seed(0)
    means = (torch.randn(60, 3, generator=g).double() + torch.tensor([0, 0, 3.0])).requires_grad_()
    quats = (torch.randn(60, 4, generator=g).double() * 3).requires_grad_()
    scales, intrinsic = torch.rand(60, 3, generator=g).double(), torch.from_numpy(K)
    pose = torch.from_numpy(look_at(np.array([0.3, -0.2, -0.5]), np.array([0, 0.1, 3.0])))
    given = means, quats, scales, pose, intrinsic, 0.05

    def plainly(means, quats):
        axes = rotation_matrices(quats)
        normals = axes[torch.arange(60), :, scales.argmin(1)] @ pose[:3, :3].T
        return inverse_depths(means @ pose[:3, :3].T + pose[:3, 3], normals, intrinsic, 0.05)

    found, wanted = planes_in_view(*given), plainly(means, quats)
    torch.testing.assert_close(found, wanted)
    axes = rotation_matrices(quats)[torch.arange(60), :, scales.argmin(1)]
    along = torch.nn.functional.cosine_similarity(axes, means + pose[:3, :3].T @ pose[:3, 3])
    assert 5 < (along.abs() < GRAZING).sum() < 40
    slope = torch.randn(60, 3, generator=g).double()
    gradients = [
        torch.autograd.grad((made * slope).sum(), (means, quats)) for made in (found, wanted)
    ]
    for ours, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-9, atol=1e-9)


def test_lookouts_see_a_room_from_within_whichever_way_is_up():
    rng = np.random.default_rng(0)
    means = rng.uniform((-2, -3, 0), (2, 3, 2.5), (500, 3))
    for up in ((0, 0, 1.0), (0, -1.0, 0), (0.6, 0, 0.8)):
        turn = upright(np.array(up))
        poses, Ks = lookouts(means @ turn, np.full(500, 0.9), np.array(up))
        eyes = centers(poses) @ turn.T
        assert len(poses) == len(Ks) == 108
        assert (np.abs(eyes - (0, 0, 1.25)) < (1.2, 1.8, 0.2)).all()
        found, sure = common_up(poses)
        np.testing.assert_allclose(found, up, atol=1e-6)
        assert sure > 0.8


def test_cubes_of_fewer_pixels_than_most_and_empty_views_give_no_points():
    at, floats = [0, 0, 0.01], [1.0, 1, 1]
    found = fused(np.array([at] * 20 + [floats] * 7), np.ones((27, 3)), EDGE)
    np.testing.assert_allclose(found.means, [at])
    np.testing.assert_allclose(found.eyes, [[1, 1, 1]])
    few = np.array([at] * 6 + [floats] * 3)  # a wider room, of as many pixels
    np.testing.assert_allclose(fused(few, few, EDGE).means, [at, floats])
    assert len(fused(few[4:6], few[4:6], EDGE).means) == 0
    raw, _ = tiles((0, 0, 1.0), (0, 0, 0))
    away = look_at(np.array([0, 0, 1.0]), np.array([1.0, 0, 1.2]))[None]
    assert len(surface(raw, away, K[None], SIZE).means) == 0


@pytest.mark.parametrize("unit", [1.0, 30.0])
def test_points_of_swept_depth_lie_where_the_views_see_them(unit):
    """Of a wall at z = 2 before two cameras, one of which knows half of it."""
    depths = np.full((2, SIZE[1], SIZE[0]), 2 * unit, np.float32)
    depths[1, :, : SIZE[0] // 2] = 0
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = -0.5 * unit  # of a camera half a metre along x
    found = swept_surface(depths, np.stack([K, K]), poses, unit)
    np.testing.assert_allclose(found.means[:, 2], 2 * unit, rtol=1e-5)
    width = 2 * SIZE[0] / K[0, 0] / 2  # of what a view sees, to either side
    assert (
        found.means[:, 0].min() < (0.1 - width) * unit
        and found.means[:, 0].max() > (0.4 + width) * unit
    )
    assert 100 < len(found.means) < 6 * width * width / EDGE_SWEPT**2
    left = found.means[:, 0] < -0.1 * unit
    np.testing.assert_allclose(found.eyes[left], 0, atol=1e-6 * unit)
    assert found.eyes[~left, 0].max() > 0.4 * unit
    nothing = swept_surface(np.zeros_like(depths), np.stack([K, K]), poses, unit)
    assert nothing.means.shape == (0, 3)
