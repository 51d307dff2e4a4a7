"""Photos that come alone: cameras, lenses and poses are found, and models that are not to be
believed are refused.
"""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from shared import data, run_stage

from benchmarks.scenes import lenses
from chebsplat.cameras import centers
from chebsplat.errors import DataFailure
from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.reconstruction import judge, posing
from chebsplat.stages.reconstruction.adjustment import alignment
from chebsplat.stages.reconstruction.matching import all_pairs, empty_database
from chebsplat.stages.reconstruction.posing import further
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.settings import IngestSection, PoseSection
from chebsplat.stages.sources import assembly, colmap, colmap_model, photos
from chebsplat.stages.sources.cameras import FACES, Camera
from chebsplat.stages.sources.common import Frame, Listing, Shot, file_of
from chebsplat.stages.sources.generated import photograph
from chebsplat.synthetic.mesh import Soup
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from chebsplat.synthetic.shuffled import build

GOOD = {
    "n_registered": 20, "n_given": 20, "n_in_others": [], "n_misplaced": 0, "n_points": 4000,
    "points_a_view": 400.0,
    "track_length": 4.0, "reprojection_error_px": 0.5, "reprojection_error": 4e-4,
    "mapped_error": 5e-4, "focal_spread": 0.01, "own_focals": False,
    "pairs_agree": 0.95, "pairs_level": 0.1, "angle_degrees": 15.0,
}  # fmt: skip


def pairs_of(n, agree, deny=()):
    rows = [*agree, *deny]
    return judge.Pairs(
        list(range(100, 100 + n)), np.array(rows), np.repeat([0.7, 0.0], [len(agree), len(deny)])
    )


def ring(first, n):
    return [(first + k, first + (k + 1) % n) for k in range(n)]


@pytest.mark.parametrize(
    ("found", "absent"),
    [
        (pairs_of(8, ring(0, 8)), []),
        (pairs_of(8, ring(0, 7), [(7, 2), (7, 3)]), [7]),  # what has no pair that agrees
        (pairs_of(9, [*ring(0, 8), (8, 0)], [(8, 3), (8, 4)]), [8]),
        (
            pairs_of(12, ring(0, 7) + ring(7, 4) + [(11, 0), (11, 7)], [(11, 3), (11, 4), (11, 8)]),
            [7, 8, 9, 10, 11],
        ),
        (pairs_of(8, ring(0, 8), [(0, 4)]), []),  # one in three tells nothing
    ],
)
def test_photos_that_their_pairs_contradict_are_left_out_and_groups_that_hang_on_them(
    found, absent
):
    assert judge.misplaced(found) == [100 + k for k in absent]


def whole(first, n):
    """Pairs of n photos in a row, each with the six after it."""
    return [(first + i, first + j) for i in range(n) for j in range(i + 1, min(i + 7, n))]


def between(n, m):
    return [(i, 12 + j) for i in range(n) for j in range(m)]


TWO = whole(0, 12) + whole(12, 12)


@pytest.mark.parametrize(
    ("found", "joining"),
    [
        (pairs_of(24, TWO + between(2, 2), between(9, 9)[-20:]), between(2, 2)),
        (pairs_of(24, TWO + between(5, 5), between(9, 9)[-20:]), []),  # most agree
        (pairs_of(24, TWO + between(2, 2)), []),
        (pairs_of(24, whole(0, 24), [(0, 20), (1, 22), (7, 16)]), []),
        (pairs_of(17, whole(0, 12) + whole(12, 5) + between(1, 1), between(9, 4)[-20:]), []),
    ],
)
def test_pairs_are_doubted_that_join_two_parts_which_most_pairs_hold_apart(found, joining):
    assert judge.joint(found) == [(100 + i, 100 + j) for i, j in joining]


def write_features(folder, features, camera=""):
    """A database of photos of 800x600 pixels with `features`, {point: pixel} of each, matched.

    Args: camera: parameters of their lens; "": a guess.
    """
    files = [file_of(photo) for photo in range(len(features))]
    for file in files:
        Image.new("RGB", (800, 600)).save(folder / file)
    database = empty_database(folder / "database.db")
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = "SIMPLE_RADIAL", camera
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, files, reader)
    with pycolmap.Database.open(database) as opened:
        ids = [opened.read_image_with_name(file).image_id for file in files]
        for photo, pixels in enumerate(features):
            opened.write_keypoints(ids[photo], np.array(list(pixels.values()), np.float32))
        for i, j in all_pairs(len(files)):
            _, rows, others = np.intersect1d(
                list(features[i]), list(features[j]), return_indices=True
            )
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            geometry.inlier_matches = np.stack([rows, others], 1).astype(np.uint32)
            if len(rows):
                opened.write_two_view_geometry(ids[i], ids[j], geometry)
    return database


def two_parts(folder, repeats):
    """Shots of two parts of a room, twelve photos each, their poses [24, 4, 4], and a database of
    features and matches. Seven photos of each part see 40 points between the parts. Where something
    repeats, four others of each part see 90 points of their own part, matched as if the same.
    """
    rng, middles = np.random.default_rng(0), np.array([[-3.0, 0, 0], [3.0, 0, 0]])
    poses = np.tile(np.eye(4), (24, 1, 1))
    turns = np.tile(np.linspace(-0.6, 0.6, 12), 2)
    poses[:, :3, :3] = Rotation.from_euler("y", turns[:, None]).as_matrix()
    moved = middles.repeat(12, 0) + [[0, 0.3 * (-1) ** k, 0] for k in range(24)]
    poses[:, :3, 3] = [0, 0, 6] - np.einsum("vij,vj->vi", poses[:, :3, :3], moved)
    repeated = rng.uniform(-1.5, 1.5, (90, 3))
    turned = repeated[:, [1, 2, 0]]
    seen = [  # points, the first of their numbers, photos
        (middles[0] + rng.uniform(-1.5, 1.5, (150, 3)), 0, range(12)),
        (middles[1] + rng.uniform(-1.5, 1.5, (150, 3)), 150, range(12, 24)),
        (rng.uniform(-0.5, 0.5, (40, 3)), 300, [*range(7), *range(12, 19)]),
        (middles[0] + repeated, 340, range(8, 12)),
        (middles[1] + turned, 340, range(20, 24)),
    ]
    features = [dict[int, np.ndarray]() for _ in poses]
    for points, first, photos_of in seen if repeats else seen[:3]:
        for photo in photos_of:
            local = points @ poses[photo, :3, :3].T + poses[photo, :3, 3]
            pixels = 400 * local[:, :2] / local[:, 2:] + [400, 300]
            features[photo] |= dict(enumerate(pixels + rng.normal(0, 0.2, pixels.shape), first))
    database = write_features(folder, features, "400,400,300,0")
    return [Shot(file_of(k), folder / file_of(k), (800, 600)) for k in range(24)], poses, database


@pytest.mark.parametrize("repeats", [True, False])
def test_parts_that_what_repeats_has_joined_are_joined_by_what_they_share(
    repeats, tmp_path, caplog
):
    shots, poses, database = two_parts(tmp_path, repeats)
    job = Job({}, Config(), tmp_path / "out", tmp_path)
    with caplog.at_level("INFO", "chebsplat"):
        model = posing._mapped(job, shots, tmp_path, database, PoseSection())
    assert ("16 pairs of photos may join two parts wrongly" in caplog.text) == repeats
    assert len(model.names) == 24 and model.judged["doubts"] == []
    scale, rotation, shift = alignment(model.cam_from_world, poses)
    found = scale * centers(model.cam_from_world) @ rotation.T + shift
    assert np.abs(found - centers(poses)).max() < 0.02  # metres where noise is .2 pixels


def test_photos_taken_side_by_side_without_a_focal_length_register(tmp_path, caplog):
    rng, poses = np.random.default_rng(0), np.tile(np.eye(4), (12, 1, 1))
    grid = np.stack(np.meshgrid(np.arange(4) - 1.5, np.arange(3) - 1.0), -1).reshape(-1, 2)
    turns = Rotation.from_euler("xyz", rng.uniform(-1, 1, (12, 3)), degrees=True)
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = -turns.apply(np.pad(0.1 * grid, ((0, 0), (0, 1))))  # 4 to 9 away
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (400, 3))
    features = []
    for pose in poses:
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = 560 * local[:, :2] / local[:, 2:] + [400, 300] + rng.normal(0, 0.2, (400, 2))
        inside = ((pixels > 0) & (pixels < [800, 600])).all(1)
        features.append({point: pixels[point] for point in np.flatnonzero(inside)})
    database = write_features(tmp_path, features)
    job = Job({}, Config(), tmp_path / "out", tmp_path)
    usual = posing._models_from(16.0, job, 12, tmp_path, database, PoseSection())
    assert not usual or usual[0].num_reg_images() < 6
    with caplog.at_level("INFO", "chebsplat"):
        model = posing._models(job, 12, tmp_path, database, PoseSection())[0]
    assert "mapping again, from pairs of a smaller angle" in caplog.text
    assert model.num_reg_images() == 12
    (camera,) = model.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(560, rel=0.02)


@pytest.mark.parametrize("zoom", [0.0, 0.1])
def test_photos_whose_focal_lengths_differ_have_their_own(zoom, tmp_path):
    rng, turns = np.random.default_rng(0), np.linspace(-0.8, 0.8, 16)
    poses, focals = np.tile(np.eye(4), (16, 1, 1)), 500 * np.linspace(1, 1 + zoom, 16)
    poses[:, :3, :3] = Rotation.from_euler("y", turns[:, None]).as_matrix()
    poses[:, 2, 3] = 6
    points = rng.uniform(-1.8, 1.8, (200, 3))
    features = []
    for pose, focal in zip(poses, focals, strict=True):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = focal * local[:, :2] / local[:, 2:] + [400, 300]
        features.append(dict(enumerate(pixels + rng.normal(0, 0.2, pixels.shape))))
    database = write_features(tmp_path, features)
    shots = [Shot(file_of(k), tmp_path / file_of(k), (800, 600)) for k in range(16)]
    job = Job({}, Config(), tmp_path / "out", tmp_path)
    model = posing._mapped(job, shots, tmp_path, database, PoseSection())
    assert len(model.names) == 16 and model.judged["doubts"] == []
    assert len(model.cameras) == (16 if zoom else 1)
    found = [model.cameras[k][1][0] for k in model.camera]
    assert found == pytest.approx(focals if zoom else 16 * [500], rel=0.01)
    scale, rotation, shift = alignment(model.cam_from_world, poses)
    away = scale * centers(model.cam_from_world) @ rotation.T + shift - centers(poses)
    assert np.abs(away).max() < 0.03  # of a unit, at 6 units; with one focal length .2


@pytest.mark.parametrize(
    ("error", "n_observations", "better"), [(0.9, 99, True), (0.99, 100, False), (0.5, 90, False)]
)
def test_own_focal_lengths_are_better_where_points_fit_and_stay(error, n_observations, better):
    def model(error, n_observations):
        return SimpleNamespace(
            compute_mean_reprojection_error=lambda: error,
            compute_num_observations=lambda: n_observations,
        )

    assert posing._fits_better(model(error, n_observations), model(1.0, 100)) == better


@pytest.mark.parametrize(
    ("found", "angles", "kept"),
    [  # (photos registered, pairs that agree) of the largest model at each angle
        ([(6, 9)], [16.0], 0),
        ([(5, 9), (12, 40)], [16.0, 2.0], 1),
        ([(5, 9), (12, 8)], [16.0, 2.0], 0),
        ([None, (2, 1)], [16.0, 2.0], 1),
    ],
)
def test_mapping_begins_again_where_few_register_and_counts_where_more_pairs_agree(
    monkeypatch, found, angles, kept
):
    class Model:
        def __init__(self, n, n_agree):
            self.n, self.n_agree = n, n_agree

        def num_reg_images(self):
            return self.n

    models, tried = [[Model(*one)] if one else [] for one in found], []
    monkeypatch.setattr(
        posing, "_models_from", lambda angle, *_: tried.append(angle) or models[len(tried) - 1]
    )
    monkeypatch.setattr(judge, "pairs", lambda model, *_: model)
    assert posing._models(None, 12, None, None, PoseSection()) is models[kept]
    assert tried == angles


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"n_in_others": [8], "n_registered": 12}, "2 groups that hardly meet"),
        ({"n_registered": 15}, "5 of 20 photos could not be placed"),
        (
            {"n_misplaced": 3, "n_registered": 17},
            "3 photos are left out that most of their matches contradict",
        ),
        ({"pairs_agree": 0.5}, "Only 50% of the pairs"),
        ({"mapped_error": 3e-3}, "lock focus and zoom"),
        ({"focal_spread": 0.2}, "Focal lengths of the photos differ by 22%, where one is assumed"),
        ({"focal_spread": 0.2, "own_focals": True}, "which makes poses less exact"),
        ({"points_a_view": 30.0}, "only 30 points"),
    ],
)
def test_what_speaks_against_a_model_is_said(changed, said):
    assert judge.doubts(GOOD) == []
    (doubt,) = judge.doubts(GOOD | changed)
    assert said in doubt


@pytest.mark.parametrize(
    ("n", "changed", "said"),
    [
        (8, {}, r"8 of 20 photos registered"),
        (20, {"angle_degrees": 0.4}, "from one place"),
        (20, {"pairs_level": 0.95}, "or show one plane"),
    ],
)
def test_a_model_that_is_not_to_be_believed_is_refused(n, changed, said):
    none = np.zeros((0, 3))
    model = PhotoModel(["a"] * n, [], np.zeros(n), np.zeros((n, 4, 4)), none, none, none[:, 0],
                       none[:, :2],
                       judged=GOOD | changed | {"doubts": []})  # fmt: skip
    with pytest.raises(DataFailure, match=said):
        judge.check(model, 0.5)


@pytest.mark.parametrize(
    ("settings", "lens", "registered", "tried"),
    [
        ({}, "SIMPLE_RADIAL", 0.7, [("SIMPLE_RADIAL", 0.002)]),
        ({}, "SIMPLE_RADIAL", 0.2, [("OPENCV_FISHEYE", 0.002), ("SIMPLE_RADIAL", 0.002)]),
        ({}, "EQUIRECTANGULAR", 0.2, [("EQUIRECTANGULAR", 0.002)]),
        ({"camera": "OPENCV"}, "OPENCV", 0.2, [("OPENCV", 0.002)]),
        ({"peak_threshold": 0.001}, "SIMPLE_RADIAL", 0.2, [("OPENCV_FISHEYE", 0.001)]),
    ],
)
def test_more_features_are_tried_and_a_fisheyes_lens_where_a_plain_one_is_none(
    settings, lens, registered, tried
):
    assert PoseSection().peak_threshold > 0.002
    assert further(lens, PoseSection(**settings), registered) == tried


def panorama(width):
    """All directions, each in its own colour, u8 [H, 2H, 3]."""
    x, y = np.meshgrid(
        (np.arange(width) + 0.5) / width * 2 - 1, (np.arange(width // 2) + 0.5) / width * 4 - 1
    )
    longitude, latitude = x * np.pi, y * np.pi / 2
    rays = [
        np.sin(longitude) * np.cos(latitude),
        np.sin(latitude),
        np.cos(longitude) * np.cos(latitude),
    ]
    return (127.5 + 127.5 * np.stack(rays, -1)).round().astype(np.uint8)


def test_faces_of_a_photo_of_all_directions_show_each_direction_where_their_poses_say(tmp_path):
    file = tmp_path / "a.png"
    Image.fromarray(panorama(800)).save(file)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0],
        [1, 2, 3],
    )
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    camera = Camera("EQUIRECTANGULAR", (800.0, 400.0), 800, 400)
    fields = assembly.assemble(
        Listing("photos", [Frame("a", file, camera, pose)], upright=True),
        IngestSection(min_views=1),
    )
    assert fields["names"] == [f"a.{name}" for name in FACES]
    _, height, width, _ = fields["images"].shape
    assert height / width == pytest.approx(1.5, abs=0.01)
    pixels = np.stack(
        [*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), np.ones((height, width))],
        -1,
    )
    for image, K, found in zip(
        fields["images"], fields["Ks"], fields["cam_from_world"], strict=True
    ):
        rays = pixels @ np.linalg.inv(K).T @ found[:3, :3] @ pose[:3, :3].T  # in the photo's frame
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        inside = (slice(2, -2), slice(2, -2))
        assert np.abs(127.5 + 127.5 * rays - image)[inside].max() < 3
        assert np.allclose(centers(found[None]), centers(pose[None]))


def test_what_a_photo_of_all_directions_shows_is_seen_by_the_view_that_faces_it():
    rng, camera = np.random.default_rng(0), Camera("EQUIRECTANGULAR", (80.0, 40.0), 80, 40)
    views = [
        view for name in "abc" for view in assembly.faces(Frame(name, None, camera, np.eye(4)))
    ]
    points, tracks = (
        rng.normal(size=(150, 3)),
        np.stack([np.repeat(np.arange(150), 3), np.tile(np.arange(3), 150)], 1),
    )
    cloud = colmap_model.Cloud(points, np.zeros((150, 3), np.uint8), np.ones(150), tracks)
    poses = np.stack([view.pose for view in views])
    fields = {
        "names": [view.name for view in views],
        "cam_from_world": poses,
        "source": {"notes": []},
    }
    point, view = colmap.points_of(cloud, list("abc"), fields)["tracks"].T
    assert len(point) == 450
    seen = np.einsum("tij,tj->ti", poses[view, :3, :3], points[point])
    assert (seen[:, 2] >= np.abs(seen[:, 0]) - 1e-9).all()


def test_a_photo_of_all_directions_closes_at_its_sides_and_a_wide_one_does_not(tmp_path):
    for name, pixels in {
        "all": panorama(400),
        "wide": panorama(400)[:, 60:260].repeat(2, 1),
    }.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    (closed, wide), _ = photos._listed(tmp_path)
    assert closed.panorama and not wide.panorama


def posed(folder, out, **settings):
    """The exit code of the stage `pose`, and its model."""
    config = {
        "source": {"kind": "photos", "path": str(folder)},
        "pose": settings,
        "ingest": {"max_side": 400},
    }
    code = run_stage("pose", out, config=config)
    return code, PhotoModel.read(out) if code == 0 else None, config


@pytest.mark.data
@pytest.mark.xdist_group("sfm")
def test_poses_and_the_lens_of_photos_are_found_and_what_it_bends_is_undone(tmp_path):
    """Photos whose own lens moves their corners by less than 1 % of the -0.15 r² that is added."""
    focal, cut, folder = 687.5, 20, tmp_path / "photos"
    folder.mkdir()
    files = sorted((data("fox") / "images").iterdir())[15:27]
    for file in files:
        small = Image.open(file).convert("RGB").resize((540, 960), Image.Resampling.BOX)
        Image.fromarray(bent(np.asarray(small), focal, -0.15, cut)).save(
            folder / f"{file.stem}.png"
        )
    shutil.copy(folder / f"{files[0].stem}.png", folder / "copy.png")
    code, model, config = posed(folder, tmp_path / "model")
    assert code == 0 and len(model.names) == 12
    name, params, width, height = model.cameras[0]
    assert (name, width, height) == ("RADIAL", 500, 920)
    r2 = (250**2 + 460**2) / params[0] ** 2  # of a corner
    assert params[3] * r2 + params[4] * r2**2 == pytest.approx(-0.15 * r2, abs=0.02)
    assert any("copies" in note for note in model.notes) and model.judged["doubts"] == []
    assert run_stage("ingest", tmp_path / "capture", {"model": tmp_path / "model"}, config) == 0
    capture = Capture.read(tmp_path / "capture")
    assert capture.points is not None and len(capture.tracks) > len(capture.points)
    frames = json.loads((data("fox") / "transforms.json").read_text())["frames"]
    given = {
        frame["file_path"].split("/")[-1].split(".")[0]: np.array(frame["transform_matrix"])
        for frame in frames
    }
    true = np.linalg.inv(
        np.stack([given[name] @ np.diag([1, -1, -1, 1]) for name in capture.names])
    )
    scale, rotation, shift = alignment(capture.cam_from_world, true)
    there = scale * centers(capture.cam_from_world) @ rotation.T + shift
    away = np.linalg.norm(there - centers(true), axis=1)
    assert (
        np.median(away)
        < 0.03 * np.linalg.norm(centers(true) - centers(true).mean(0), axis=1).mean()
    )


def bent(pixels, focal, k, cut):
    """A pinhole picture u8 [H, W, 3] of a focal length as a lens of this k sees it, borders cut
    off.
    """
    from scipy.ndimage import map_coordinates

    height, width = pixels.shape[:2]
    y, x = np.mgrid[cut : height - cut, cut : width - cut] + 0.5
    x, y = (x - width / 2) / focal, (y - height / 2) / focal
    flat = np.hypot(x, y)
    straight = flat.copy()
    for _ in range(20):  # r' = r (1 + k r²), solved for r
        straight = flat / (1 + k * straight**2)
    grow = np.where(flat > 0, straight / np.maximum(flat, 1e-12), 1)
    at = [y * grow * focal + height / 2 - 0.5, x * grow * focal + width / 2 - 0.5]
    return np.stack(
        [map_coordinates(pixels[..., c], at, order=1, mode="nearest") for c in range(3)], -1
    )


def plain_photos(folder):
    for k in range(4):
        Image.fromarray(np.full((60, 80, 3), 40 * k, np.uint8)).save(folder / f"{k}.png")


def one_photo_in_copies(folder):
    for k in range(6):
        shutil.copy(min((data("fox") / "images").iterdir()), folder / f"{k}.jpg")


def turned_on_the_spot(folder):
    """Views of one panorama."""
    whole = np.asarray(
        Image.open(min((data("captures") / "flat360/images").iterdir())).convert("RGB")
    )
    for k in range(10):
        camera = Camera("EQUIRECTANGULAR", (1600.0, 800.0), 1600, 800, turn=45.0 + 9 * k)
        view = assembly.geometry(camera, 640)
        pixels = assembly.resampled(
            Image.fromarray(whole), camera, view, assembly.positions(camera, view)
        )
        Image.fromarray(pixels).save(folder / f"{k}.png")


@pytest.mark.data
@pytest.mark.xdist_group("sfm")
@pytest.mark.parametrize("made", [plain_photos, one_photo_in_copies, turned_on_the_spot])
def test_what_tells_no_depth_is_refused_before_anything_is_trained(made, tmp_path):
    (tmp_path / "photos").mkdir()
    made(tmp_path / "photos")
    assert posed(tmp_path / "photos", tmp_path / "model")[0] == 4


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.xdist_group("sfm")
def test_two_rooms_in_one_folder_are_told_apart(tmp_path):
    (tmp_path / "photos").mkdir()
    for room in ("lunddoor", "flat360"):
        for k, file in enumerate(sorted((data("captures") / room / "images").iterdir())[:11]):
            with Image.open(file) as image:
                side = min(image.size)
                image.convert("RGB").crop((0, 0, side, side)).resize((700, 700)).save(
                    tmp_path / f"photos/{room}{k}.png"
                )
    code, model, _ = posed(tmp_path / "photos", tmp_path / "model")
    assert code == 4 or any(
        "groups" in doubt or "could not be placed" in doubt for doubt in model.judged["doubts"]
    )


def with_a_mirror(room):
    """The room whose wall of the largest x is a mirror: in its place the room again, mirrored."""
    soup, width, flip = room.soup, room.size[0], np.diag([-1.0, 1, 1])
    kept = (soup.vertices[soup.triangles][..., 0] < width - 1e-4).any(1)
    beyond = np.array([2 * width, 0, 0])
    room.soup = Soup(
        np.r_[soup.vertices, soup.vertices @ flip + beyond].astype(np.float32),
        np.r_[soup.triangles[kept], soup.triangles[kept] + len(soup.vertices)],
        np.tile(soup.labels[kept], 2),
        np.tile(soup.materials[kept], 2),
        np.r_[soup.parts[kept], soup.parts[kept] + len(soup.origins)],
        np.r_[soup.origins, soup.origins @ flip + beyond],
        np.r_[soup.rotations, soup.rotations @ flip],
    )
    lights = room.lights.copy()
    lights[:, 0] = lights[:, 0] @ flip + beyond
    room.lights = np.r_[room.lights, lights]
    return room


@pytest.fixture(scope="module")
def mirrored():
    """A room with a mirror, K, poses of a walk around it, and its photos u8 [V, H, W, 3]."""
    room, K = with_a_mirror(build("office", 31_001)), intrinsics(480, 360, 84.0)
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    poses = walk(room.size, 20, 31_001)
    return room, K, poses, [photograph(room, caster, K, pose, 480, 360)[0] for pose in poses]


PLAIN, ZOOMED = lenses.Lens(0, 0, 1.0), lenses.Lens(0, 0, 0.5)


@pytest.mark.slow
@pytest.mark.xdist_group("sfm")
@pytest.mark.parametrize(
    ("lens_of", "right"),
    [
        (lambda k: PLAIN, True),
        (lambda k: (PLAIN, ZOOMED)[k >= 10], False),  # zoomed halfway
        (lambda k: (lenses.LENSES["action"], lenses.LENSES["zoom"])[k % 2], False),
        (lambda k: lenses.Lens(0, 0, 1 - 0.015 * k), False),
        (lambda k: lenses.Lens(0, 0, 1 - 0.005 * k), True),
    ],
    ids=["one lens", "zoomed", "two lenses by turns", "a zoom of a third", "a zoom of a tenth"],
)
def test_a_mirror_is_no_trouble_and_photos_of_two_lenses_are_not_passed_in_silence(
    mirrored, lens_of, right, tmp_path
):
    room, K, exact, images = mirrored
    (tmp_path / "photos").mkdir()
    for k, image in enumerate(images):
        photo = lenses.through(image.astype(np.float64), K, lens_of(k))
        photo += np.random.default_rng(k).normal(0, lenses.NOISE, photo.shape)
        Image.fromarray(photo.round().clip(0, 255).astype(np.uint8)).save(
            tmp_path / f"photos/{k:02d}.png"
        )
    code, model, _ = posed(tmp_path / "photos", tmp_path / "model")
    if not right:
        assert code == 4 or any("lock focus and zoom" in doubt for doubt in model.judged["doubts"])
        return
    assert code == 0 and model.judged["doubts"] == [] and len(model.names) == len(images)
    scale, rotation, shift = alignment(model.cam_from_world, exact)
    eyes, points = (
        scale * of @ rotation.T + shift for of in (centers(model.cam_from_world), model.points)
    )
    assert np.linalg.norm(eyes - centers(exact), axis=1).max() < 0.05  # metres, in a room of 4.7
    assert (points[:, 0] > room.size[0] + 0.2).sum() > 20  # of the mirror's picture


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.xdist_group("sfm")
@pytest.mark.parametrize(("name", "least"), [("goproboard", 18), ("flat360", 10)])
def test_fisheyes_and_photos_of_all_directions_are_posed_without_a_word_about_their_lens(
    name, least, tmp_path
):
    code, model, _ = posed(data("captures") / name / "images", tmp_path / "model")
    assert code == 0 and len(model.names) >= least
    assert artifact.read_manifest(tmp_path / "model").facts["n_registered"] == len(model.names)
