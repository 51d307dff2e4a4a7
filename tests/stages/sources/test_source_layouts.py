"""A generated scene laid out as each data set lays out its own comes back as the same capture."""

import json
import shutil

import layouts
import numpy as np
import pytest
from PIL import Image
from shared import data, published, run_stage
from source_folders import SETTINGS, image, save, tiny

from chebsplat.cameras import centers, unproject
from chebsplat.errors import DataFailure, InputError
from chebsplat.evaluation.protocols import scannet_closed, scannet_open
from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import colmap, common, generated, replica, scannet, seven_scenes
from chebsplat.synthetic.rays import RayCaster
from chebsplat.synthetic.shuffled import build
from tests.stages.sources.test_sources import agreement

KINDS = {"replica": replica, "colmap": colmap, "scannet": scannet, "seven_scenes": seven_scenes}


@pytest.fixture(scope="module")
def scene():
    """A toy room; unknown depth and labels in a corner; some points."""
    fields = generated.capture("toy", 1, "toy")
    fields["depth"][:, :9, :7], fields["labels"][:, :9, :7] = np.nan, -1
    fields["depth"] = layouts.stored_depth(fields["depth"]).astype(np.float32) / np.float32(1000)
    fields["depth"][fields["depth"] == 0] = np.nan
    rng = np.random.default_rng(0)
    fields["points"] = rng.uniform(0, 3, (200, 3)).astype(np.float32)
    fields["point_colors"] = rng.integers(0, 255, (200, 3)).astype(np.uint8)
    return fields


def with_classes(scene, names):
    """The scene with its k-th class called by the (k + 7)-th of `names`, so that shelves and
    counter are among them.
    """
    return scene | {"labels": np.where(scene["labels"] < 0, -1,
                                       (scene["labels"] + 7) % len(names)).astype(np.int16),
                    "class_names": list(names)}  # fmt: skip


def compare(found, scene, labels=True, depth=True, exact_Ks=True):
    assert np.array_equal(found["images"], scene["images"])
    assert np.abs(found["cam_from_world"] - scene["cam_from_world"]).max() < 1e-6
    assert "loss_mask" not in found
    if exact_Ks:
        assert np.abs(found["Ks"] - scene["Ks"]).max() < 1e-6
    if labels:
        names = [*found["class_names"], None]
        wanted = [*scene["class_names"], None]
        assert (np.array(names)[found["labels"]] == np.array(wanted)[scene["labels"]]).all()
    if depth:
        assert np.array_equal(np.isnan(found["depth"]), np.isnan(scene["depth"]))
        assert np.nanmax(np.abs(found["depth"] - scene["depth"])) < 5e-4  # half a stored millimetre


def read(folder, kind, **settings):
    assert common.detect(folder) == kind
    module = KINDS[kind]
    fields = module.read(folder, IngestSection(min_views=2, **settings))
    probe = module.probe(folder)
    assert probe.pop("pseudo_labels", False) == ("pseudo_labels" in fields)
    assert probe == {"poses": True, "depth": "depth" in fields, "labels": "labels" in fields}
    assert all(path.is_file() for path in module.files(folder))
    return fields


def test_replica_as_nice_slam_renders_it(scene, tmp_path):
    folder = tmp_path / "office0"
    layouts.write_nice_slam(folder, scene)
    shutil.move(folder / "cam_params.json", tmp_path)  # of all rooms
    compare(read(folder, "replica"), scene, labels=False)
    assert len(replica.files(folder)) == 2 * 16 + 2


@pytest.mark.parametrize("ending", [".png", ".npy"])
def test_replica_as_semantic_nerf_renders_it(scene, tmp_path, ending):
    layouts.write_semantic_nerf(tmp_path, scene)
    for path in (tmp_path / "Sequence_1/semantic_class").iterdir():
        ids = np.asarray(Image.open(path))
        path.unlink()
        np.save(path.with_suffix(".npy"), ids) if ending == ".npy" else save(path, ids)
        assert path.with_suffix(ending) in replica.files(tmp_path)
    found = read(tmp_path, "replica")
    compare(found, scene, exact_Ks=False)  # the layout has no camera file: f is half the width
    assert np.allclose(found["Ks"], [[48, 0, 48], [0, 48, 36], [0, 0, 1]])


def test_deep_blending_or_any_colmap_folder(scene, tmp_path):
    layouts.write_colmap(tmp_path, scene)
    compare(read(tmp_path, "colmap"), scene)


@pytest.mark.parametrize("unknown", [0, 65_535])
def test_seven_scenes(scene, tmp_path, unknown):
    """Depth and poses are of a camera beside the photo's; no file of the layout is of the
    photo's.
    """
    photo, depth = (78.9, 48.465, 35.535), (87.75, 48, 36)
    Ks = np.array([[[f, 0, cx], [0, f, cy], [0, 0, 1]] for f, cx, cy in (photo, depth)])
    beside = scene["cam_from_world"].copy()
    beside[:, :3, 3] -= seven_scenes.OFFSET
    soup = build("toy", 1).soup
    caster = RayCaster(soup.vertices, soup.triangles)
    pixels = np.stack(np.meshgrid(np.arange(96), np.arange(72)), -1).reshape(-1, 2) + 0.5

    def seen(K, poses):
        hits = [generated.trace(caster, K, pose, pixels)[0] for pose in poses]
        return np.stack([hit.distance.reshape(72, 96) for hit in hits])

    exact, stored = seen(Ks[0], scene["cam_from_world"]), seen(Ks[1], beside)
    fields = scene | {"cam_from_world": beside, "depth": stored, "Ks": np.tile(Ks[1], (16, 1, 1))}
    layouts.write_seven_scenes(tmp_path / "seq-01", fields, unknown=unknown)
    first = read(tmp_path / "seq-01", "seven_scenes")
    shutil.move(tmp_path / "seq-01/camera-intrinsics.txt", tmp_path)
    found = read(tmp_path, "seven_scenes")
    assert found["names"][:2] == ["seq-01/frame-000000", "seq-01/frame-000001"]
    assert np.array_equal(found["depth"], first["depth"], equal_nan=True)
    compare(found, scene | {"Ks": np.tile(Ks[0], (16, 1, 1))}, labels=False, depth=False)
    known = np.isfinite(found["depth"])
    assert known.mean() > 0.7  # what both see
    error = np.abs(found["depth"] / exact - 1)[known]
    assert np.quantile(error, 0.95) < 0.015  # 0.007: slopes; 0.046 with OFFSET the other way


def test_scannet_as_semantic_gaussians_lays_it_out(scene, tmp_path):
    scene = with_classes(scene, scannet_open.CLASSES)
    layouts.write_scannet_sg(tmp_path / "scene0000_00", scene)
    found = read(tmp_path / "scene0000_00", "scannet")
    compare(found, scene, depth=False)
    assert found["names"][:3] == ["0", "10", "20"]
    assert np.array_equal(found["points"], scene["points"])
    assert np.array_equal(found["point_colors"], scene["point_colors"])
    assert "is_test" not in found


def with_pseudo_labels(scene):
    """Blocks of 2 x 2 pixels share a label and a confidence; some have none."""
    rng = np.random.default_rng(0)
    n, height, width = scene["labels"].shape
    blocks = rng.integers(-1, 21, (n, height // 2, width // 2)).astype(np.int16)
    sure = np.where(blocks >= 0, rng.random(blocks.shape), 0).astype(np.float16)
    pseudo, confidence = (part.repeat(2, 1).repeat(2, 2) for part in (blocks, sure))
    return scene | {"pseudo_labels": pseudo, "confidence": confidence}


def test_scannet_as_panoptic_lifting_lays_it_out_with_its_pseudo_labels(scene, tmp_path):
    scene = with_pseudo_labels(with_classes(scene, scannet_closed.CLASSES))
    folder = tmp_path / "scene0000_00"
    layouts.write_scannet_pl(folder, scene)
    found = read(folder, "scannet")
    compare(found, scene)
    assert np.flatnonzero(found["is_test"]).tolist() == [0, 5, 10, 15] and "points" not in found
    assert np.array_equal(found["pseudo_labels"], scene["pseudo_labels"])
    assert np.array_equal(found["confidence"], scene["confidence"])
    assert found["pseudo_labels"].dtype == np.int16 and (found["pseudo_labels"] == -1).any()
    assert "Not read: segmentation_data.pkl." in found["source"]["notes"]
    assert {path.name for path in scannet.files(folder)} >= {"10.npz", "splits.json"}
    shutil.rmtree(folder / "rs_semantics")  # scenes in the wild have pseudo labels alone
    again = read(folder, "scannet")
    assert "labels" not in again and again["class_names"] == list(scannet_closed.CLASSES)
    assert np.array_equal(again["pseudo_labels"], scene["pseudo_labels"])


def test_frames_that_no_list_of_a_split_names_are_left_out_and_counted(scene, tmp_path):
    layouts.write_scannet_pl(tmp_path, with_classes(scene, scannet_closed.CLASSES))
    (tmp_path / "splits.json").write_text(json.dumps({"train": ["0", "20"], "test": ["40"]}))
    found = scannet.read(tmp_path, SETTINGS)
    assert found["names"] == ["0", "20", "40"] and found["is_test"].tolist() == [False, False, True]
    assert any("13 frames are in neither list" in note for note in found["source"]["notes"])


def test_scannets_own_labels_are_reduced_and_corrected_by_object(scene, tmp_path):
    scene = with_classes(scene, scannet_closed.CLASSES)
    # doors are object 6, which this scene's correction makes a table
    objects = np.where(scene["labels"] == 7, 6, 9)
    layouts.write_scannet_pl(tmp_path / "scene0423_02", scene, folded=False, objects=objects)
    shutil.copytree(tmp_path / "scene0423_02", tmp_path / "scene0000_00")
    compare(read(tmp_path / "scene0000_00", "scannet"), scene)
    corrected = scene | {"labels": np.where(scene["labels"] == 7, 6, scene["labels"])}
    found = read(tmp_path / "scene0423_02", "scannet")
    compare(found, corrected)
    assert any("1 objects" in note for note in found["source"]["notes"])


def test_shelves_and_counter_have_swapped_ids_in_the_two_layouts(tmp_path):
    layouts.write_table(tmp_path / "t.tsv", "cocomapid", layouts.COCO_IDS)
    names = scannet.mapped(tmp_path / "t.tsv")
    assert (names[8], names[35]) == ("shelves", "counter")  # ids 10 and 11
    assert scannet_open.CLASSES[9:11] == ("shelves", "counter")
    assert scannet_closed.CLASSES[9:11] == ("counter", "shelves")
    assert scannet_closed.REDUCED[10] == scannet_closed.REDUCED[15] == "shelves"
    assert scannet_closed.REDUCED[12] == "counter"
    assert set(scannet_closed.REDUCED) == {"void", *scannet_closed.CLASSES}


@pytest.mark.parametrize(
    ("write", "kind"),
    [(layouts.write_nice_slam, "replica"), (layouts.write_seven_scenes, "seven_scenes"),
     (layouts.write_scannet_sg, "scannet")],
)  # fmt: skip
def test_jpegs_lose_only_what_jpeg_loses(scene, tmp_path, write, kind):
    write(tmp_path, with_classes(scene, scannet_open.CLASSES), suffix="jpg")
    found = read(tmp_path, kind)
    assert 0 < np.abs(found["images"].astype(int) - scene["images"]).mean() < 4  # quality 75


def test_only_the_chosen_views_are_read(scene, tmp_path):
    layouts.write_seven_scenes(tmp_path, scene)
    for k in range(1, 15):
        (tmp_path / f"frame-{k:06d}.color.png").write_bytes(b"damaged")
    assert len(read(tmp_path, "seven_scenes", max_views=2)["names"]) == 2


def test_frames_without_a_pose_are_left_out_and_counted(scene, tmp_path):
    layouts.write_scannet_sg(tmp_path, with_classes(scene, scannet_open.CLASSES))
    (tmp_path / "pose/30.txt").write_text(("-inf " * 4 + "\n") * 4)
    (tmp_path / "color/50.png").unlink()
    found = read(tmp_path, "scannet")
    assert found["names"][:5] == ["0", "10", "20", "40", "60"]
    assert "1 poses have no image" in found["source"]["notes"][1]
    assert any(
        "1 of 15 frames have a pose that is not finite" in note for note in found["source"]["notes"]
    )


def test_intrinsics_of_the_whole_sensor_and_labels_of_its_size_fit_reduced_images(tmp_path):
    layouts.write_scannet_sg(tmp_path, tiny(2, (648, 484)))
    ids = np.full((968, 1296), 2, np.uint16)
    ids[:, 649:] = 8  # left of it, what lies under 324.5 of the reduced pixels
    for k in range(2):
        save(tmp_path / f"label-filt/{10 * k}.png", ids)
    K = np.array([[1170.0, 0, 647.5, 0], [0, 1170, 483.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    layouts.write_text(tmp_path / "intrinsic/intrinsic_color.txt", layouts.matrix_text(K))
    found = scannet.read(tmp_path, IngestSection(protocol="scannet-open", min_views=2))
    assert np.allclose(found["Ks"][0], [[585, 0, 324], [0, 585, 242], [0, 0, 1]])
    row = [found["class_names"][k] for k in found["labels"][0, 100]]
    assert row == ["chair"] * 324 + ["shelves"] * 324
    image(tmp_path / "label-filt/10.png", (640, 640), mode="L")
    with pytest.raises(InputError, match=r"label-filt/10\.png is 640x640"):
        scannet.read(tmp_path, IngestSection(protocol="scannet-open", min_views=2))


def test_depth_of_another_camera_is_looked_up_through_both_cameras(scene, tmp_path):
    """A depth camera of half the resolution and two thirds of the focal length sees more than the
    photo.
    """
    layouts.write_scannet_pl(tmp_path, with_classes(scene, scannet_closed.CLASSES))
    K = np.eye(4)
    K[:2, :3] = [[44.0, 0, 47.5], [0, 44.0, 35.5]]
    layouts.write_text(tmp_path / "intrinsic/intrinsic_depth.txt", layouts.matrix_text(K))
    columns = np.tile(np.arange(96, dtype=np.uint16) + 1000, (72, 1))
    for path in (tmp_path / "depth").iterdir():
        save(path, columns)
    found = scannet.read(tmp_path, SETTINGS)
    f = scene["Ks"][0, 0, 0]
    wanted = np.floor((np.arange(96) + 0.5 - 48) * 44 / f + 48)
    assert np.allclose(found["depth"][0, 30], (wanted + 1000) / 1000)


@pytest.mark.parametrize(("metres", "first", "last"), [(1, 3, 88), (10, 5, 90)])
def test_depth_of_seven_scenes_sees_less_than_the_photo_beside(
    scene, tmp_path, metres, first, last
):
    layouts.write_seven_scenes(tmp_path, scene)
    (tmp_path / "camera-intrinsics.txt").unlink()
    for k in range(16):
        save(tmp_path / f"frame-{k:06d}.depth.png", np.full((72, 96), 1000 * metres, np.uint16))
    found = seven_scenes.read(tmp_path, SETTINGS)
    seen = np.isfinite(found["depth"][0, 30])
    assert np.flatnonzero(seen).tolist() == [*range(first, last + 1)]
    assert np.allclose(found["depth"][0, 30, seen], metres)
    assert "78.9 pixels" in found["source"]["notes"][0]
    with pytest.raises(InputError, match="no frame"):
        seven_scenes.read(tmp_path / "..", SETTINGS)


SAYING_NOTHING = {
    "none": lambda seen: None,
    "black": lambda seen: 0 * seen,
    "white": lambda seen: 0 * seen + 255,
    "one colour": lambda seen: 0 * seen + np.array([7, 200, 7], np.uint8),
    "0 and 1 for 0 and 255": lambda seen: (seen > 127).astype(np.uint8),
    "at random": lambda seen: (
        np.random.default_rng(0).integers(0, 256, seen.shape).astype(np.uint8)
    ),
    "black but for a few": lambda seen: (
        seen * (np.arange(len(seen))[:, None] < 10).astype(np.uint8)
    ),
}


@pytest.mark.parametrize("colors", ["theirs", *SAYING_NOTHING])
def test_a_sources_own_points_become_the_scenes_and_their_colours_where_these_tell_something(
    scene, tmp_path, colors
):
    """All but five lie on what the views show. Theirs: what is shown, darker by 3."""
    pixels = np.argwhere(np.ones((72, 96), bool))[::23]
    parts = [
        unproject(scene["depth"][k], scene["Ks"][k], scene["cam_from_world"][k], pixels)
        for k in range(0, 16, 4)
    ]
    points = np.concatenate([*parts, np.full((5, 3), 50.0)]).astype(np.float32)
    shown = [scene["images"][k][pixels[:, 0], pixels[:, 1]] for k in range(0, 16, 4)]
    shown = np.concatenate([*shown, np.zeros((5, 3), np.uint8)])[np.isfinite(points).all(1)]
    points = points[np.isfinite(points).all(1)]
    theirs = shown - np.minimum(shown, 3)
    given = theirs if colors == "theirs" else SAYING_NOTHING[colors](shown)
    fields = {key: scene[key] for key in ("names", "images", "Ks", "cam_from_world")}
    record = Capture(**fields, is_test=np.arange(16) % 8 == 0, points=points, point_colors=given)
    capture = published(tmp_path / "c", record)
    config = {"sfm": {"max_points": 100_000, "dense": "off"}}
    assert run_stage("sfm", tmp_path / "out", {"capture": capture}, config) == 0
    found = Points.read(tmp_path / "out")
    facts = artifact.read_manifest(tmp_path / "out").facts
    assert facts["how"] == "source" and facts["n_candidates"] == len(points)
    assert facts["n_unseen"] >= 5 and len(found.means) == len(points) - facts["n_unseen"]
    row = {tuple(point): k for k, point in enumerate(points.tolist())}
    rows = [row[tuple(point)] for point in found.means.tolist()]
    apart = np.abs(found.colors - (theirs if colors == "theirs" else shown)[rows].astype(float))
    # where no wall hides a point
    assert not apart.any() if colors == "theirs" else np.median(apart) < 4
    to_eyes = centers(scene["cam_from_world"])[None] - found.means[:, None]
    facing = (np.einsum("ni,nvi->nv", found.normals, to_eyes) > 0).mean()
    assert facing > 0.8  # most points of a convex room are turned towards most cameras


def test_points_that_no_view_has_in_its_image_are_too_few_with_depth_too(scene, tmp_path, capfd):
    fields = {key: scene[key] for key in ("names", "images", "Ks", "cam_from_world", "depth")}
    record = Capture(
        **fields, is_test=np.arange(16) % 8 == 0, points=np.full((50, 3), 50, np.float32)
    )
    inputs = {"capture": published(tmp_path / "c", record)}
    assert (
        run_stage("sfm", tmp_path / "out", inputs, {"sfm": {"dense": "off"}})
        == DataFailure.exit_code
    )
    assert "only 0 points were found" in capfd.readouterr().err


@pytest.mark.data
def test_the_red_kitchens_depth_agrees_between_views():
    folder = data("redkitchen")
    assert common.detect(folder) == "seven_scenes"
    assert len(seven_scenes.files(folder)) == 3 * 120 + 1
    fields = seven_scenes.read(folder, IngestSection(max_side=80, max_views=60))
    fields["labels"] = np.zeros(fields["depth"].shape, int)
    shares = [agreement(fields, k, k + 1)[0] for k in range(0, 59, 6)]
    # of all pixels, 80 % of which have depth; 0.38 where the camera turns fastest
    assert min(shares) > 0.3
    fields["cam_from_world"] = np.linalg.inv(fields["cam_from_world"])
    assert (
        np.median([agreement(fields, k, k + 1)[0] for k in range(0, 59, 6)])
        < np.median(shares) - 0.1
    )
