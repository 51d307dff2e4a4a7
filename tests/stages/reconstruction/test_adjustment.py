"""Poses that a sensor gave are adjusted to the photos, in the frame and units that they were given
in.
"""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from chebsplat.cameras import centers
from chebsplat.stages.reconstruction.adjustment import (
    adjust,
    alignment,
    bundle_all,
    differences,
    frame,
    localized,
)
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.sfm import filled


def poses_of(rotations, places):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", rotations, places)
    return poses


@pytest.mark.parametrize("on_a_line", [False, True])
def test_alignment_finds_the_similarity_between_two_worlds(on_a_line):
    rng = np.random.default_rng(0)
    places = np.outer(np.arange(8.0), [1, 2, 3]) if on_a_line else rng.normal(size=(8, 3))
    rotations, turn = Rotation.random(8, rng=rng).as_matrix(), Rotation.random(rng=rng).as_matrix()
    given = poses_of(rotations, places)
    # world = 0.3 turn x + (4, 5, 6)
    found = poses_of(rotations @ turn, (places - [4, 5, 6]) @ turn / 0.3)
    scale, rotation, shift = alignment(found, given)
    assert scale == pytest.approx(0.3)
    np.testing.assert_allclose(rotation, turn, atol=1e-9)
    np.testing.assert_allclose(shift, [4, 5, 6], atol=1e-9)


def test_alignment_of_views_from_one_place_keeps_units():
    rotations = Rotation.random(4, rng=np.random.default_rng(1)).as_matrix()
    poses = poses_of(rotations, np.ones((4, 3)))
    scale, rotation, shift = alignment(poses, poses)
    assert scale == 1
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(shift, 0, atol=1e-9)


def test_a_bundle_adjustment_of_all_is_colmaps_own_but_for_its_words(capfd):
    noise, options = pycolmap.SyntheticNoiseOptions(), pycolmap.BundleAdjustmentOptions()
    noise.point2D_stddev, noise.point3D_stddev = 1.0, 0.05
    options.print_summary = False
    ours = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions())
    pycolmap.synthesize_noise(noise, ours)
    before = [image.cam_from_world().matrix() for image in ours.images.values()]
    theirs = pycolmap.Reconstruction(ours)
    bundle_all(ours, options)
    assert capfd.readouterr() == ("", "")
    pycolmap.bundle_adjustment(theirs, options)
    found, wanted = (
        [image.cam_from_world().matrix() for image in model.images.values()]
        for model in (ours, theirs)
    )
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    assert not np.allclose(found, before, atol=1e-4)


def test_points_of_depth_fill_what_triangulation_leaves():
    rng = np.random.default_rng(2)
    own, more = rng.random((40, 3)), rng.random((400, 3))
    tracks = np.stack([np.repeat(np.arange(40), 2), np.tile([0, 1], 40)], 1)
    cloud = {
        "means": own,
        "colors": np.zeros((40, 3), np.uint8),
        "seen_from": np.zeros(40, int),
        "tracks": tracks,
    }
    added = {"means": more, "colors": np.ones((400, 3), np.uint8), "seen_from": np.ones(400, int)}
    both = filled(cloud | {"notes": {}}, added, 200)
    first = both["notes"]["n_from_depth"]
    assert 0 < first < len(both["means"]) <= 200
    triangulated = both["colors"][:, 0] == 0
    assert triangulated.sum() == len(both["means"]) - first
    assert set(both["tracks"][:, 0]) == set(np.flatnonzero(triangulated))
    held = {tuple(point) for point in own}
    assert all(
        (tuple(point) in held) == mine
        for point, mine in zip(both["means"], triangulated, strict=True)
    )


@pytest.fixture
def synthetic(tmp_path):
    """A database of 16 views of 300 points, known to half a pixel, the true poses, and a job."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 16, 300
    options.camera_model_id, options.camera_params = (
        pycolmap.CameraModelId.PINHOLE,
        [900, 900, 512, 384],
    )
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, truth, database)
    images = sorted(truth.images.values(), key=lambda image: image.name)
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    job = Job({}, Config(), tmp_path / "out", tmp_path)
    (tmp_path / "images").mkdir()
    return job, tmp_path / "database.db", [image.name for image in images], poses


def model_of(database, names, poses, focal):
    """Cameras with these poses, and no points."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image for image in opened.read_all_images()}
    for name, pose in zip(names, poses, strict=True):
        image = images[name]
        params = [focal, focal, 512, 384]
        if not model.exists_camera(image.camera_id):
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE",
                    width=1024,
                    height=768,
                    params=params,
                    camera_id=image.camera_id,
                )
            )
        fresh = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(fresh, pycolmap.Rigid3d(pose[:3]))
    return model


def errors(poses, truth):
    """Mean distance of centres, in the views' mean distance from their middle, and mean angle,
    degrees.
    """
    scale, rotation, shift = alignment(poses, truth)
    size = np.linalg.norm(centers(truth) - centers(truth).mean(0), axis=1).mean()
    apart = np.linalg.norm(
        scale * centers(poses) @ rotation.T + shift - centers(truth), axis=1
    ).mean()
    turns = np.einsum("vij,kj,vlk->vil", poses[:, :3, :3], rotation, truth[:, :3, :3])
    return np.array([apart / size, np.degrees(Rotation.from_matrix(turns).magnitude().mean())])


def disturbed(truth):
    """Poses half a degree and a hundredth of the scene's size off the true ones; that size."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.radians(0.5) * rng.normal(size=(len(truth), 3))).as_matrix()
    size = np.linalg.norm(centers(truth) - centers(truth).mean(0), axis=1).mean()
    places = centers(truth) + 0.01 * size * rng.normal(size=(len(truth), 3))
    return poses_of(turns @ truth[:, :3, :3], places), size


def held_by(model, names):
    held = {image.name: image for image in model.images.values()}
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3] = [held[name].cam_from_world().matrix() for name in names]
    return poses


def test_disturbed_poses_and_a_wrong_focal_length_are_found_again(synthetic):
    job, database, names, truth = synthetic
    given, size = disturbed(truth)
    model, notes = adjust(job, model_of(database, names, given, 927.0), database, names, given)
    found = held_by(model, names)
    assert errors(given, truth).min() > 0.005
    assert (errors(found, truth) < errors(given, truth) / 5).all()
    assert notes["focal_px"][1] == pytest.approx(900, rel=0.003)
    assert model.compute_mean_reprojection_error() < 1 < notes["reprojection_error_given_px"]
    assert notes["poses_kept"] == 0
    # in the frame that was given
    assert np.linalg.norm(centers(found) - centers(given), axis=1).mean() < 0.03 * size


def test_views_that_went_astray_do_not_turn_the_frame():
    rng = np.random.default_rng(4)
    places, rotations = rng.normal(size=(20, 3)), Rotation.random(20, rng=rng).as_matrix()
    given = poses_of(rotations, places)
    turns = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=(20, 3))).as_matrix()
    turns[:2] = Rotation.from_rotvec(np.radians([[0, 0, 12.0], [0, 0, 9.0]])).as_matrix()
    found = poses_of(turns @ rotations, places + 0.01 * rng.normal(size=(20, 3)))
    found[5, :3, 3] += 0.5
    framed = frame(found, given, np.arange(20) != 7)
    assert np.flatnonzero(~framed.led).tolist() == [0, 1, 5, 7]
    assert np.degrees(framed.spread[0]) == pytest.approx(0.3, rel=0.4)
    assert framed.spread[1] == pytest.approx(0.01, rel=0.4)
    assert np.degrees(np.arccos((np.trace(framed.rotation) - 1) / 2)) < 0.15
    assert np.degrees(Rotation.from_matrix(alignment(found, given)[1]).magnitude()) > 0.3


def test_a_view_is_found_among_the_points_of_others_or_stays_where_it_was_given(synthetic):
    job, database, names, truth = synthetic
    spread = np.radians(0.5), 0.02
    options = {"clear_points": True, "refine_intrinsics": False}
    model = model_of(database, names, truth, 900.0)
    model = pycolmap.triangulate_points(
        model, database, job.scratch / "images", job.scratch, **options
    )
    turn = Rotation.from_rotvec([0.008, -0.006, 0.004]).as_matrix()
    given = poses_of(
        (turn @ truth[3, :3, :3])[None], centers(truth)[3:4] + np.array([0.02, -0.02, 0.01])
    )[0]
    held = {image.name: image for image in model.images.values()}
    view, others = held[names[3]], [held[name] for name in names if name != names[3]]
    pose = np.eye(4)
    pose[:3] = localized(model, database, view, given, spread, others)
    before, after = (np.ravel(differences(p[None], truth[3:4])) for p in (given, pose))
    assert (after < before / 5).all()
    np.testing.assert_allclose(
        localized(model, database, view, given, spread, []), given[:3], atol=1e-9
    )
    far = poses_of(
        (Rotation.from_rotvec([0.3, 0, 0]).as_matrix() @ truth[3, :3, :3])[None],
        centers(truth)[3:4],
    )[0]
    np.testing.assert_allclose(
        localized(model, database, view, far, spread, others), far[:3], atol=1e-9
    )


@pytest.mark.parametrize("weak", [1, 3])
def test_views_with_few_matches_stay_near_where_they_were_given(synthetic, weak):
    job, database, names, truth = synthetic
    given, size = disturbed(truth)
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image.image_id for image in opened.read_all_images()}
        for name in names[:weak]:
            for other in names:
                if other != name and opened.exists_two_view_geometry(images[name], images[other]):
                    geometry = opened.read_two_view_geometry(images[name], images[other])
                    geometry.inlier_matches = geometry.inlier_matches[:2]
                    opened.update_two_view_geometry(images[name], images[other], geometry)
    model, notes = adjust(job, model_of(database, names, given, 900.0), database, names, given)
    found = held_by(model, names)
    assert notes["poses_kept"] == weak
    moved, turned = differences(found[:weak], given[:weak])
    assert (moved < 0.1 * size).all() and (np.degrees(turned) < 4).all()
    assert (errors(found[weak:], truth[weak:]) < errors(given[weak:], truth[weak:]) / 5).all()


def test_only_the_last_round_decides_whether_views_share_enough(synthetic, monkeypatch):
    from chebsplat.stages.reconstruction import adjustment

    job, database, names, truth = synthetic
    # at a hundredth of a pixel no point is left at first
    monkeypatch.setattr(adjustment, "ROUNDS", (0.01, 4.0, 2.0))
    model, notes = adjust(job, model_of(database, names, truth, 900.0), database, names, truth)
    assert notes["poses_kept"] == 0
    assert model.num_points3D() > 200


def test_poses_stay_where_few_views_share_points(synthetic, monkeypatch):
    from chebsplat.stages.reconstruction import adjustment

    job, database, names, truth = synthetic
    monkeypatch.setattr(adjustment, "SHARED", 10_000)
    start = model_of(database, names, truth, 900.0)
    model, notes = adjust(job, start, database, names, truth)
    assert model is start
    assert notes == {"poses_kept": len(names)}
