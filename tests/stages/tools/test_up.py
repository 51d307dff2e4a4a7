"""Up is where the user says, or where cameras or the floor are; pages, orbits, meshes and scenes
follow it.
"""

import json
from functools import lru_cache

import numpy as np
import pytest
from box_room import made
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from shared import data

from chebsplat.cameras import centers
from chebsplat.errors import ConfigError
from chebsplat.formats.meshes import Mesh
from chebsplat.formats.ply import write_ply
from chebsplat.formats.scene import Scene
from chebsplat.formats.splats import read_splats
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.cli.group import Upward
from chebsplat.splats.gaussians import local_shape
from chebsplat.splats.parts import cubes_of
from chebsplat.stages.tools import camera_paths, up
from chebsplat.stages.tools.mesh import turned
from chebsplat.stages.tools.page import foreign
from chebsplat.synthetic import layout, shuffled
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from tests.stages.tools.test_page import held_in
from tests.stages.tools.test_render import ring

TURNS = [Rotation.random(random_state=seed).as_matrix() for seed in range(4)] + [
    np.eye(3),
    np.diag([1.0, -1, -1]),
]


def flat(rng, low, high, axis, n):
    """Raw parameters of n flat Gaussians, noisy by 1 cm and 5 degrees, on a side of a box."""
    means = rng.uniform(low, high, (n, 3))
    means[:, axis] += rng.normal(0, 0.01, n)
    axes = np.roll(np.eye(3), axis + 1, axis=1)  # the last column is the side's normal
    turns = Rotation.from_rotvec(rng.normal(0, np.radians(5), (n, 3))) * Rotation.from_matrix(axes)
    return means, turns


def furnished(turn, rng):
    """A room of 5 x 4 x 2.5 m, a table and a chest in it, and a tenth of blobs, z turned to `turn`
    z.
    """
    boxes = [
        ((0, 0, 0), (5, 4, 2.5), 2500),
        ((1, 1, 0.7), (2.4, 1.8, 0.74), 200),
        ((3, 3, 0), (4, 3.8, 1), 300),
    ]
    means, turns = [], []
    for low, high, n in boxes:
        for axis in range(3):
            for at in (low[axis], high[axis]):
                ends = np.array([low, high], float)
                ends[:, axis] = at
                area = np.prod(np.delete(np.subtract(high, low), axis))
                part = flat(rng, *ends, axis, max(int(n * area / 20), 1))
                means, turns = [*means, part[0]], [*turns, part[1].as_matrix()]
    means, turns = np.concatenate(means) @ turn.T, turn @ np.concatenate(turns)
    n = len(means)
    log_scales = np.tile(np.log([0.1, 0.08, 0.004]), (n, 1))
    log_scales[::10] = np.log(0.05)
    raw = {
        "means": means,
        "quats": Rotation.from_matrix(turns).as_quat(scalar_first=True),
        "log_scales": log_scales,
    }
    raw |= {
        "logit_opacities": np.full(n, 3.0),
        "sh0": np.zeros((n, 1, 3)),
        "shN": np.zeros((n, 15, 3)),
    }
    return {name: values.astype(np.float32) for name, values in raw.items()}


def flat_gaussians(means, normals):
    """Raw parameters of thin discs of 5 cm at points [N, 3] with these unit normals."""
    z = np.array([0, 0, 1])
    turns = np.column_stack([1 + normals @ z, np.cross(z, normals)])  # not for normal = -z
    raw = {
        "means": means,
        "quats": turns / np.linalg.norm(turns, axis=1, keepdims=True),
        "log_scales": np.tile(np.log([0.05, 0.05, 0.004]), (len(means), 1)),
        "logit_opacities": np.full(len(means), 3.0),
        "sh0": np.zeros((len(means), 1, 3)),
    }
    return {name: np.asarray(values, np.float32) for name, values in raw.items()}


@lru_cache
def seen_from_within(preset, seed):
    """Points and normals of what 20 views along the walk through a generated room show, one in a
    cube of a decimetre, noisy by a centimetre and six degrees.
    """
    room = (shuffled if preset == "shuffled" else layout).build(preset, seed)
    rng, K = np.random.default_rng(seed), intrinsics(64, 48)
    pixels = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5, [1.0]), -1)
    eyes, rays = [], []
    for pose in walk(room.size, 20, seed):
        rays.append(pixels.reshape(-1, 3) @ np.linalg.inv(K).T @ pose[:3, :3])
        eyes.append(np.tile(-pose[:3, :3].T @ pose[:3, 3], (len(rays[-1]), 1)))
    eyes, rays = np.concatenate(eyes), np.concatenate(rays)
    hits = RayCaster(room.soup.vertices, room.soup.triangles).cast(eyes, rays)
    normals = hits.normals + rng.normal(0, 0.1, hits.normals.shape)
    means = eyes + hits.distance[:, None] * rays + rng.normal(0, 0.01, eyes.shape)
    rows = np.unique(cubes_of(means, 0.1), return_index=True)[1]
    return means[rows], normals[rows] / np.linalg.norm(normals[rows], axis=1, keepdims=True)


ROOMS = [
    *(("office", seed) for seed in (3, 4, 5)),
    *(("room", seed) for seed in (3, 4)),
    *(("shuffled", seed) for seed in (3, 4, 5)),
]


def test_up_of_forty_turned_rooms_is_told_without_cameras(caplog):
    right = 0
    for number, turn in enumerate(Rotation.random(40, random_state=0).as_matrix()):
        means, normals = seen_from_within(*ROOMS[number % len(ROOMS)])
        up_found = up.up_of("auto", flat_gaussians(means @ turn.T, normals @ turn.T))
        right += up_found @ turn[:, 2] > np.cos(np.radians(3))
    assert right >= 38 and caplog.text.count("not sure which way is up") <= 2


@pytest.mark.parametrize("thing", ["guitar", "statue", "ball"])
def test_up_of_what_is_no_room_is_said_to_be_unsure(thing, caplog):
    if thing == "guitar":
        parameters, _, _ = read_splats(data("gs_ply") / "guitar_decoded_sh0.ply")
    elif thing == "statue":
        parameters = flat_gaussians(*measured_statue())
    else:
        points = np.random.default_rng(0).normal(size=(4000, 3))
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        parameters = flat_gaussians(normals, normals)
    up.up_of("auto", parameters)
    assert "not sure which way is up" in caplog.text and "--up" in caplog.text


def measured_statue():
    """Points of a COLMAP model, and the normals of their neighbourhoods."""
    import pycolmap

    model = pycolmap.Reconstruction(str(data("statue_colmap") / "sparse/0"))
    points = np.stack([point.xyz for point in model.points3D.values()])
    return points, local_shape(points, 16)[1]


def test_cameras_tell_up_where_they_can(caplog):
    cameras = list(ring())
    poses = np.stack([camera.cam_from_world for camera in cameras])
    room = furnished(TURNS[0], np.random.default_rng(0))
    caplog.set_level("INFO", "chebsplat")
    by_cameras = up.up_of("auto", room, poses)
    np.testing.assert_allclose(by_cameras, [0, 0, 1], atol=1e-6)  # of a ring
    assert "by the cameras" in caplog.text and "by the floor" not in caplog.text
    alike = np.tile(poses[:1], (9, 1, 1))  # all one way: they cannot
    assert up.up_of("auto", room, alike) @ TURNS[0][:, 2] > 0.99
    room = furnished(TURNS[5], np.random.default_rng(0))  # head down, to which their tops lean
    assert up.up_of("auto", room, alike)[2] > 0.99 > -0.99 > up.up_of("auto", room)[2]
    assert caplog.text.count("by the floor") == 3


@pytest.mark.parametrize(("text", "found"), [
    ("z", [0, 0, 1]), ("-y", [0, -1, 0]), ("+x", [1, 0, 0]), ("0,-2,0", [0, -1, 0]),
    ("-3,0,4", [-0.6, 0, 0.8]),
    ("auto", "auto"), ("w", None), ("--y", None), ("1,2", None), ("0,0,0", None), ("nan,0,1", None),
    ("", None),
])  # fmt: skip
def test_up_is_a_letter_three_numbers_or_auto(text, found):
    if found is None:
        with pytest.raises(ConfigError, match="three numbers"):
            Upward().convert(text, None, None)
    elif isinstance(found, str):
        assert Upward().convert(text, None, None) == found
    else:
        np.testing.assert_allclose(Upward().convert(text, None, None), found, atol=1e-12)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return made(tmp_path_factory.mktemp("up") / "box room")[0]


def run(*arguments):
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize(
    ("asked", "wanted"),
    [("z", [0, 0, 1]), ("-x", [-1, 0, 0]), ("auto", TURNS[0][:, 2]), (None, TURNS[0][:, 2])],
)
def test_page_and_scene_of_a_splat_stand_upright(tmp_path, asked, wanted):
    ply = tmp_path / "theirs.ply"
    write_ply(ply, furnished(TURNS[0], np.random.default_rng(0)), 0)
    choice = [] if asked is None else ["--up", asked]
    run("page", ply, *choice, "--out", tmp_path / "theirs.html")
    np.testing.assert_allclose(held_in(tmp_path / "theirs.html")[0]["up"], wanted, atol=0.03)
    run("lift", ply, *choice, "--out", tmp_path / "made")
    held = Scene.read(tmp_path / "made/export")
    pose = held.cameras.cam_from_world[0]
    np.testing.assert_allclose(-pose[1, :3], wanted, atol=0.03)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0
    low, high = np.quantile(held.parameters["means"], (0.25, 0.75), axis=0)
    middle = pose[:3, :3] @ ((low + high) / 2) + pose[:3, 3]
    assert middle[2] > 0 and np.abs(middle[:2]).max() < 1e-3 * middle[2]  # it is looked at


def test_page_and_orbit_of_a_scene_take_up_as_given(scene, tmp_path):
    run("page", scene, "--up", "x", "--out", tmp_path / "room.html")
    assert held_in(tmp_path / "room.html")[0]["up"] == [1, 0, 0]
    given = ("--path", "orbit", "--frames", "6", "--size", "16x12")
    run("cameras", scene, *given, "--up", "-1,0,1", "--out", tmp_path / "cameras")
    rows = json.loads((tmp_path / "cameras/cameras.json").read_text())
    heights = np.array([row["position"] for row in rows]) @ np.array([-1, 0, 1])
    assert np.ptp(heights) < 1e-6  # a level round
    level = np.array([np.array(row["rotation"])[:, 0] for row in rows]) @ np.array([-1, 0, 1])
    assert np.abs(level).max() < 1e-6  # horizons are level
    command = ["cameras", str(scene), "--up", "z", "--out", str(tmp_path / "no")]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 2 and "leave out --up or --path" in done.output


def test_orbits_without_up_are_as_before_and_with_it_go_round_it():
    cameras = list(ring())
    plain = camera_paths.orbit(cameras, 5)
    same = camera_paths.orbit(
        cameras, 5, camera_paths.common_up(np.stack([c.cam_from_world for c in cameras]))[0]
    )
    np.testing.assert_array_equal(
        [c.cam_from_world for c in plain], [c.cam_from_world for c in same]
    )
    turned_round = np.stack(
        [c.cam_from_world for c in camera_paths.orbit(cameras, 5, np.array([0.0, 0.6, 0.8]))]
    )
    assert np.ptp(centers(turned_round) @ [0, 0.6, 0.8]) < 1e-9


@pytest.mark.parametrize(("suffix", "wanted"), [(".ply", [0, 0, 1]), (".GLB", [0, 1, 0])])
def test_a_mesh_is_turned_so_that_up_is_what_its_format_has(suffix, wanted):
    up_is = np.array([0.6, 0, -0.8])
    corners = np.array([[0, 0, 0], up_is, [0, 1, 0], np.cross(up_is, [0, 1, 0])])
    found = turned(
        Mesh(corners, np.array([[0, 1, 2]]), np.zeros((4, 3), np.uint8)), up_is, suffix
    ).vertices
    np.testing.assert_allclose(found[1], wanted, atol=1e-6)
    np.testing.assert_allclose(found[1:] @ found[1:].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(found[1:]) * np.linalg.det(corners[1:]) > 0  # turned, not mirrored


@pytest.mark.parametrize("log_scales", [[[720, 720, 720]], [[100, 400, 400]] * 4])
def test_huge_gaussians_are_shown_upright_with_the_rest(tmp_path, log_scales):
    room = furnished(TURNS[1], np.random.default_rng(0))
    room["log_scales"][: len(log_scales)] = log_scales
    room["logit_opacities"][len(log_scales) :: 2] = -800
    write_ply(tmp_path / "huge.ply", room, 0)
    scene = foreign(tmp_path / "huge.ply")
    assert -scene.cameras.cam_from_world[0, 1, :3] @ TURNS[1][:, 2] > 0.99
    assert np.isfinite(camera_paths.draw_surface(scene.parameters)).all()


def test_what_has_walls_and_nothing_in_it_is_not_called_no_room(caplog):
    box = np.random.default_rng(0).uniform(0, 1, (3000, 3)) * [5, 4, 2.5]
    rows, axes = np.arange(3000), np.arange(3000) % 3
    ends = np.array([5, 4, 2.5])[axes] * (rows // 3 % 2)
    box[rows, axes] = ends
    up.up_of("auto", flat_gaussians(box, np.eye(3)[axes]))
    assert "nothing in it tells up from down" in caplog.text
