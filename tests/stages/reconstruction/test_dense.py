"""Points between matched ones come from depth on which several photos agree."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from chebsplat.photos import plane_sweep
from chebsplat.stages.reconstruction import dense
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.settings import SfmSection

FOCAL, SIZE = 160.0, (160, 120)
OTHERS = np.array([[k for k in range(5) if k != view] for view in range(5)])


@pytest.fixture(scope="module")
def wall():
    """Five photos of a textured wall at z = 4 behind a nearer square at z = 2.5, from places along
    x; depth of each.
    """
    rng = np.random.default_rng(0)
    coarse = torch.from_numpy(rng.random((2, 1, 60, 80))).float()
    textures = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bilinear").numpy()[
        :, 0
    ]
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    rays = np.stack([(x - SIZE[0] / 2) / FOCAL, (y - SIZE[1] / 2) / FOCAL], -1)
    images, depths, poses = [], [], []
    for place in np.linspace(-0.4, 0.4, 5):
        near, far = (rays * z + [place, 0] for z in (2.5, 4.0))
        front = (np.abs(near) < 0.35).all(-1)
        at = np.where(front[..., None], near, far)
        pick = [
            ((at[..., side] + 2) * 40).clip(0, limit - 1).astype(int)
            for side, limit in ((1, 240), (0, 320))
        ]
        images.append(np.where(front, textures[0][tuple(pick)], textures[1][tuple(pick)]))
        depths.append(np.where(front, 2.5, 4.0))
        pose = np.eye(4)
        pose[0, 3] = -place
        poses.append(pose)
    pixels = (255 * np.stack(images)[..., None].repeat(3, -1)).astype(np.uint8)
    return pixels, np.tile(K, (5, 1, 1)), np.stack(poses), np.stack(depths)


@pytest.fixture
def job(tmp_path):
    return Job({}, Config(), tmp_path / "out", tmp_path)


def cloud_of(wall):
    _, Ks, poses, _ = wall
    means = np.random.default_rng(1).uniform([-0.3, -0.3, 2.5], [0.3, 0.3, 4.0], (20, 3))
    return {
        "names": [str(k) for k in range(5)], "Ks": Ks, "cam_from_world": poses, "means": means,
        "colors": np.zeros((20, 3), np.uint8), "seen_from": np.zeros(20, int),
        "tracks": np.zeros((0, 2), np.int32),
        "notes": {},
    }  # fmt: skip


def capture_of(wall, **more):
    fields = {
        "names": [str(k) for k in range(5)],
        "images": wall[0],
        "size": SIZE,
        "loss_mask": None,
        "depth": None,
    }
    return SimpleNamespace(
        **(fields | {"is_test": np.array([False, False, True, False, False])} | more)
    )


def test_a_sweep_finds_depth_between_its_steps(wall):
    images, Ks, poses, depths = wall
    grey = torch.from_numpy(images[..., 0]).float() / 255
    tried = 1 / torch.linspace(1 / 1.5, 1 / 12, 48)
    found, cost = plane_sweep.swept_depth(
        grey,
        torch.ones_like(grey),
        torch.from_numpy(Ks).float(),
        torch.from_numpy(poses).float(),
        2,
        [0, 1, 3, 4],
        tried,
    )
    inner = np.s_[15:-15, 30:-30]
    right = np.abs(found.numpy()[inner] / depths[2][inner] - 1) < 0.02
    assert right.mean() > 0.85  # not along the square's edge, which windows blur
    assert np.median(cost.numpy()[inner]) < 0.2


def test_views_confirm_true_depth_and_deny_another(wall):
    _, Ks, poses, depths = wall
    true = depths.astype(np.float32)
    agree = plane_sweep.agreed(true, Ks, poses, OTHERS, 2)
    np.testing.assert_allclose(agree[2][agree[2] > 0], true[2][agree[2] > 0], rtol=1e-6)
    assert (agree[2] > 0).mean() > 0.95
    wrong = true.copy()
    wrong[2] *= 1.2
    assert (plane_sweep.agreed(wrong, Ks, poses, OTHERS, 2)[2] > 0).mean() < 0.05
    noisy = true.copy()
    noisy[2] *= 1.01
    mean = plane_sweep.agreed(noisy, Ks, poses, OTHERS, 2)[2]
    assert (np.abs(mean / true[2] - 1) < 0.004).mean() > 0.8  # four right ones, and its own


def test_what_other_views_see_through_goes_however_many_share_it(wall):
    _, Ks, poses, depths = wall
    floating = depths.astype(np.float32)
    corner = np.s_[5:20, 60:90]  # of the wall
    # two views share a thing in the air; three see the wall behind it
    floating[:2][:, *corner] = 1.6
    kept = plane_sweep.agreed(floating, Ks, poses, OTHERS, 1)
    assert (kept[0][corner] > 0).mean() < 0.3
    assert (kept[4][corner] > 0).mean() > 0.9  # which hides nothing from these, and denies nothing


def test_unknown_depth_and_views_that_compare_with_none_stay_unknown(wall):
    _, Ks, poses, depths = wall
    nobody = np.full((5, 1), -1)
    assert not plane_sweep.agreed(depths.astype(np.float32), Ks, poses, nobody, 1).any()
    holes = depths.astype(np.float32)
    holes[:, :60] = 0
    assert not plane_sweep.agreed(holes, Ks, poses, OTHERS, 1)[:, :60].any()


def test_points_beside_the_cameras_leave_a_sweep_where_it_looks(wall, job):
    """Views from within a room have points behind the edges of every photo, nearer than anything in
    it.
    """
    cloud = cloud_of(wall)
    beside = np.random.default_rng(2).uniform([1, -1, 0.01], [3, 1, 0.1], (20, 3))
    both = cloud | {"means": np.concatenate([cloud["means"], beside])}
    assert len(dense.swept(job, capture_of(wall), both)["means"]) == len(
        dense.swept(job, capture_of(wall), cloud)["means"]
    )


def test_swept_points_lie_on_the_surfaces_and_come_from_training_views(wall, job):
    found = dense.swept(job, capture_of(wall), cloud_of(wall))
    z = found["means"][:, 2]
    off = np.minimum(np.abs(z / 2.5 - 1), np.abs(z / 4 - 1))
    assert len(z) > 8_000
    assert np.quantile(off, 0.9) < 0.003
    depth = found["depths"]  # of a view that is none of training, all unknown
    assert depth.shape == wall[3].shape
    assert not depth[2].any()
    known = depth > 0
    assert known[[0, 1, 3, 4]].mean() > 0.5
    assert np.quantile(np.abs(depth[known] / wall[3][known] - 1), 0.9) < 0.005
    assert set(found["seen_from"].tolist()) <= {0, 1, 3, 4}
    assert found["colors"].shape == found["means"].shape


def test_masked_pixels_give_no_points(wall, job):
    mask = np.ones(wall[0].shape[:3], bool)
    mask[:, :, :80] = False
    found = dense.swept(job, capture_of(wall, loss_mask=mask), cloud_of(wall))
    assert not found["depths"][..., :80].any()
    assert (found["depths"][[0, 1, 3, 4], :, 80:] > 0).mean() > 0.5
    place = found["means"] + wall[2][found["seen_from"], :3, 3]
    assert len(place) > 2000 and (place[:, 0] > 0).all()  # right of each camera's middle


def test_points_are_added_where_most_cells_are_empty_and_never_beside_depth(wall):
    cloud, settings = cloud_of(wall), SfmSection()
    job = SimpleNamespace(facts={})
    assert dense.wants_more(job, capture_of(wall), cloud, settings)
    assert job.facts["covered"] < 0.2
    assert not dense.wants_more(job, capture_of(wall, depth=np.ones(1)), cloud, settings)
    assert not dense.wants_more(job, capture_of(wall), cloud, SfmSection(dense="off"))
    y, x = np.mgrid[-3:3:0.05, -3:3:0.05]
    full = cloud | {"means": np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], 1)}
    assert not dense.wants_more(job, capture_of(wall), full, settings)
    assert job.facts["covered"] > 0.9
    assert dense.wants_more(job, capture_of(wall), full, SfmSection(dense="on"))


def test_where_no_point_is_known_points_of_the_photos_colours_lie_far_behind_all_others(
    wall, monkeypatch
):
    """All points but the last are in the middle; the last, five deep, is the farthest 99 of 100
    times.
    """
    # these cameras look one way
    assert len(dense.backdrop(capture_of(wall), cloud_of(wall))["means"]) == 0
    monkeypatch.setattr(dense, "FACING", -1.0)
    cloud, mask = cloud_of(wall), np.ones(wall[0].shape[:3], bool)
    cloud["means"] = np.concatenate([cloud["means"], np.tile([[0.0, 0.0, 5.0]], (20, 1))])
    mask[:, :, :24] = False
    found = dense.backdrop(capture_of(wall, loss_mask=mask), cloud)
    assert set(found["seen_from"].tolist()) == {0, 1, 3, 4}  # none of the view that is tested
    np.testing.assert_allclose(found["means"][:, 2], 7.5)
    first = found["seen_from"] == 0
    x, y = ((found["means"][first, :2] + [0.4, 0]) / 7.5 * FOCAL + [80, 60]).T
    # middles of cells of 8 pixels
    assert x.min() == pytest.approx(28) and x.max() == pytest.approx(156)
    held = dense.cells_with(wall[1][0], wall[2][0], cloud["means"], SIZE)
    assert len(x) == (~held)[:, 3:].sum() and held.any()
    cells = wall[0][0].reshape(15, 8, 20, 8, 3).mean((1, 3))
    np.testing.assert_allclose(
        found["colors"][first], cells[(y / 8).astype(int), (x / 8).astype(int)], atol=1
    )


def test_cameras_all_around_something_face_one_another_and_those_in_a_row_or_back_to_back_do_not():
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)

    def ring(distance):
        poses = np.tile(np.eye(4), (12, 1, 1))
        poses[:, 0, :3] = np.stack([np.cos(turns), 0 * turns, -np.sin(turns)], 1)
        poses[:, 2, :3] = np.stack([np.sin(turns), 0 * turns, np.cos(turns)], 1)
        poses[:, 2, 3] = distance
        return poses

    assert dense.facing(ring(3.0)) > 0.4  # the middle lies before each
    assert dense.facing(ring(-3.0)) == 0  # behind each
    row = np.tile(np.eye(4), (12, 1, 1))
    row[:, 0, 3] = np.arange(12)
    assert dense.facing(row) == 0
