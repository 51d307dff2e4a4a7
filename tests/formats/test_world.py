"""A scene is kept at a size and place for single precision, and nothing of where it was is lost."""

import numpy as np
import pytest
from plyfile import PlyData
from shared import gaussian_parameters

from chebsplat.errors import InputError
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.world import HERE, World

EYES = np.random.default_rng(0).uniform(-3, 3, (12, 3)) * [1, 1, 0.3]


@pytest.mark.parametrize("scale", [0.1, 1.0, 50.0])
@pytest.mark.parametrize("offset", [0.0, 900.0])
def test_a_sane_scene_stays_as_it_is(scale, offset):
    eyes = np.concatenate([scale * EYES + scale * offset, np.full((1, 3), np.nan)])
    assert World.of(eyes) == HERE == World.of(EYES[:1]) == World.of(eyes[-1:])
    assert HERE.notes == {} and HERE.inward(eyes) is eyes and HERE.outward(eyes) is eyes


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-3, 1e4, 1e8])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_any_other_comes_to_one_to_ten_units_about_the_origin_and_back(scale, offset):
    eyes = scale * EYES + offset
    world = World.of(eyes)
    inside = world.inward(eyes)
    extent = np.linalg.norm(inside - inside.mean(0), axis=1).max()
    assert 1 <= extent < 10 and np.linalg.norm(inside.mean(0)) <= 1000
    assert World.of(np.concatenate([eyes, [[1e30, 0, 0]]])) == world  # one gone astray
    rounding = 1e-15 * max(np.abs(eyes).max(), 1)
    assert np.abs(world.outward(inside) - eyes).max() <= 4 * rounding
    assert World.read(world.notes) == world


def test_cameras_and_gaussians_move_with_the_points():
    """A camera sees a point where it saw it, at a depth divided by the scale."""
    world = World((1e6, -2e6, 3.0), 1e-3)
    angle, pose = 0.3, np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1.0, 2.0, 3.0]
    points = np.random.default_rng(1).normal(size=(5, 3))
    outside = world.poses_outward(pose)
    seen = world.outward(points) @ outside[:3, :3].T + outside[:3, 3]
    assert np.allclose(seen / world.scale, points @ pose[:3, :3].T + pose[:3, 3], atol=1e-5)
    assert np.allclose(world.poses_inward(outside), pose, atol=1e-6)


@pytest.mark.parametrize(
    "world", [HERE, World((0.0, 0.0, 0.0), 1e-4), World((1e6, -7e5, 3.0), 1e-3)]
)
def test_a_ply_file_has_the_sources_world_and_comes_back_from_it(tmp_path, world):
    parameters = gaussian_parameters()
    write_ply(tmp_path / "a.ply", parameters, 3, world=world)
    x = PlyData.read(tmp_path / "a.ply")["vertex"]["x"]
    assert np.allclose(x, world.outward(parameters["means"])[:, 0], rtol=1e-7, atol=0)
    assert x.dtype == (np.float64 if any(world.origin) else np.float32)
    read = read_ply(tmp_path / "a.ply", world)[0]
    for name, values in parameters.items():
        assert np.allclose(read[name], values, atol=2e-6), name
    outside = read_ply(tmp_path / "a.ply")[0]
    assert np.allclose(
        np.exp(outside["log_scales"]), world.scale * np.exp(parameters["log_scales"]), rtol=1e-5
    )


@pytest.mark.parametrize(
    "notes", [3, {"origin": [1, 2]}, {"scale": 0}, {"scale": "a"}, {"size": 1}, {"origin": None}]
)
def test_a_place_that_is_none_is_refused(notes):
    with pytest.raises(InputError, match="is no place of a scene"):
        World.read({"world": notes})
