"""Sides of a room continue where no photo looks, and nowhere else."""

from types import SimpleNamespace

import numpy as np
import pytest
from box_room import looking
from scipy.spatial.transform import Rotation

from chebsplat.labels.agreement import project
from chebsplat.shape.room import CELL
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.reconstruction.enclosure import enclosed
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.sfm import with_sides
from chebsplat.stages.shape_models.surfaces import from_depth

LOW, HIGH = np.array([-2.5, -2, 0]), np.array([2.5, 2, 2.5])
SIZE = (160, 120)
K = np.array([[80.0, 0, 80], [0, 80, 60], [0, 0, 1]])
EDGE = 5 * CELL
# two photos, none of the wall behind them
EYES = [([1.8, -1.4, 1.2], [-2.5, 1, 0.8]), ([1.8, 1.4, 1.2], [-2.5, -1, 0.8])]


def side_of(points):
    """The side of the box that each point lies on: 2 axis + (1 at its high end)."""
    apart = np.stack([np.abs(points - LOW), np.abs(points - HIGH)], 2)
    return apart.reshape(len(points), 6).argmin(1)


def color_of(points):
    """Of each side its own colour, darker at x below 0."""
    light = np.where(points[:, :1] < 0, 0.5, 1)
    return (light * (np.arange(6)[side_of(points)][:, None] * [30, 20, 10] + 50)).astype(np.uint8)


def photo(pose):
    """Depth [H, W] of the inside of the box, and the points that its pixels show."""
    eye, columns = -pose[:3, :3].T @ pose[:3, 3], np.indices(SIZE).reshape(2, -1).T + 0.5
    rays = np.concatenate([columns, np.ones((len(columns), 1))], 1) @ np.linalg.inv(K).T
    with np.errstate(divide="ignore"):
        z = np.maximum((LOW - eye) / (rays @ pose[:3, :3]), (HIGH - eye) / (rays @ pose[:3, :3]))
    z = z.min(1)
    return z.reshape(SIZE).T.astype(np.float32), eye + z[:, None] * (rays @ pose[:3, :3])


def room(turn):
    """A cloud, as `sfm` has it, of what EYES see of the box, turned; and depth by view."""
    poses = np.stack([looking(*view) for view in EYES])
    depths, shown = zip(*map(photo, poses), strict=True)
    rows = np.random.default_rng(0).choice(SIZE[0] * SIZE[1], 3000, replace=False)
    means = np.concatenate([points[rows] for points in shown])
    poses[:, :3, :3] = poses[:, :3, :3] @ turn.T
    cloud = {
        "means": means @ turn.T, "colors": color_of(means), "cam_from_world": poses,
        "seen_from": np.repeat(np.arange(len(poses)), len(rows)), "Ks": np.stack([K] * len(poses)),
        "notes": {},
    }  # fmt: skip
    return cloud, depths, shown


def sides(cloud, depths):
    return enclosed(cloud, np.arange(len(depths)), depths.__getitem__, SIZE)


@pytest.mark.parametrize("turn", [np.eye(3), Rotation.from_euler("xyz", [0.4, 0.2, 1]).as_matrix()])
def test_what_no_photo_shows_of_a_room_continues_its_sides_in_their_colours(turn):
    cloud, depths, shown = room(turn)
    found, reason = sides(cloud, depths)
    points = found["means"] @ turn
    assert reason == "" and len(points) > 500
    distance = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(1)
    assert np.quantile(distance, 0.95) < EDGE / 2
    for pose in cloud["cam_from_world"]:  # whose photos have depth everywhere
        assert np.isnan(project(found["means"], K, pose, SIZE)).all()
    rng = np.random.default_rng(1)
    anywhere = LOW + rng.random((600, 3)) * ([1.8, 2, 2.5] - LOW)  # as far as the cameras
    axis, high = rng.integers(0, 3, 600), rng.integers(0, 2, 600)
    anywhere[np.arange(600), axis] = np.where(high & (axis > 0), HIGH[axis], LOW[axis])
    everything = np.concatenate([points, *shown])
    assert 1 not in side_of(points)  # the wall behind the cameras may be anywhere
    gaps = [np.linalg.norm(everything - point, axis=1).min() for point in anywhere]
    assert np.mean(np.array(gaps) < 2 * EDGE) > 0.95
    away = np.abs(points[:, 0]) > 0.5  # of the change of colours
    like = np.abs(found["colors"].astype(int) - color_of(points)).max(1) < 5
    assert np.mean(like[away]) > 0.9
    assert set(found["seen_from"]) <= {0, 1}


@pytest.mark.parametrize("unknown", [0, np.nan])
def test_where_depth_is_unknown_a_photo_shows_nothing(unknown):
    cloud, depths, _ = room(np.eye(3))
    left = np.arange(SIZE[0]) < SIZE[0] // 2
    halves = [np.where(left, depth, unknown) for depth in depths]
    points = sides(cloud, halves)[0]["means"]
    in_hole = project(points, K, cloud["cam_from_world"][0], SIZE)[:, 0] > SIZE[0] // 2 + 1
    in_both = project(points, K, cloud["cam_from_world"][1], SIZE)[:, 0] > SIZE[0] // 2 + 1
    assert (in_hole & in_both).sum() > 20  # as dense as the sides are elsewhere
    whole = sides(cloud, depths)[0]["means"]
    assert not (project(whole, K, cloud["cam_from_world"][0], SIZE)[:, 0] > 0).any()


def test_photos_that_show_nothing_alone_leave_a_room_as_it_is():
    cloud, depths, _ = room(np.eye(3))
    twice = cloud | {key: np.repeat(cloud[key], 2, 0) for key in ("cam_from_world", "Ks")}
    found, reason = sides(twice, np.repeat(depths, 2, 0))
    assert "shows 0 % that no other does" in reason and len(found["means"]) == 0


def test_no_sides_about_an_object_nor_with_a_camera_beyond():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4000, 3))
    cloud, depths, _ = room(np.eye(3))
    round_one = cloud | {"means": 5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)}
    round_one |= {"colors": np.zeros((4000, 3), np.uint8), "seen_from": np.zeros(4000, int)}
    found, reason = sides(round_one, depths)
    assert "no room" in reason and [len(values) for values in found.values()] == [0, 0, 0]
    before = set(side_of(sides(cloud, depths)[0]["means"]))
    cloud["cam_from_world"][0] = looking([0.1, 0, 4], [0, 0, 0])  # above the ceiling
    assert before - set(side_of(sides(cloud, depths)[0]["means"])) == {5}


def test_the_stage_asks_training_views_alone_and_says_why_it_adds_nothing():
    cloud, depths, _ = room(np.eye(3))
    # a third view, of the wall behind the others, is tested on
    poses = np.concatenate([cloud["cam_from_world"], [looking([0, 0, 1], [3, 0, 1])]])
    cloud |= {"cam_from_world": poses, "Ks": np.stack([K] * 3), "names": ["b", "c", "a"]}
    capture = SimpleNamespace(
        names=["a", "b", "c"], is_test=np.array([True, False, False]), size=SIZE, loss_mask=None,
        depth=np.stack([photo(cloud["cam_from_world"][2])[0], *depths]),
    )  # fmt: skip
    said = {}
    job = SimpleNamespace(config=Config(), left_out=said.__setitem__)
    alone, _ = sides(cloud, depths)
    found = with_sides(job, capture, cloud, True)
    assert said == {} and found["notes"]["n_on_sides"] == len(alone["means"]) > 0
    assert len(found["means"]) == len(cloud["means"]) + len(alone["means"])
    assert with_sides(job, capture, cloud, False) is cloud and "unit" in said.popitem()[1]
    off = SimpleNamespace(config=Config(sfm={"enclosure": "off"}), left_out=said.__setitem__)
    assert with_sides(off, capture, cloud, True) is cloud and "is off" in said.popitem()[1]
    capture.loss_mask = np.zeros((3, *SIZE[::-1]), bool)
    assert with_sides(job, capture, cloud, True) is cloud and "shows 0 %" in said.popitem()[1]


def test_knowledge_reads_nothing_where_no_photo_looks():
    cloud, depths, _ = room(np.eye(3))
    shown = len(cloud["means"])
    means = np.concatenate([cloud["means"], sides(cloud, depths)[0]["means"]])
    covariances, normals = local_shape(means, 16)

    def surface(n, notes):
        parts = {"means": means[:n], "normals": normals[:n], "covariances": covariances[:n]}
        notes |= {"largest": 0.1, "from": LOW.tolist()}
        return from_depth(SimpleNamespace(**parts, notes=notes))

    found = surface(len(means), {"n_on_sides": len(means) - shown - 9, "n_behind": 9})
    for part, other in zip(found, surface(shown, {}), strict=True):
        np.testing.assert_array_equal(part, other)
    assert len(found.means) < len(surface(len(means), {}).means)
