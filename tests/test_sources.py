"""Every layout on disk becomes the same capture, and a bad one is named with its remedy."""

import json

import numpy as np
import pytest
from PIL import Image
from shared import data

from chebsplat.cameras import unproject
from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.config import IngestSection
from chebsplat.stages.sources import colmap, common, photos, replica, transforms

SETTINGS = IngestSection(max_side=160, min_views=2)
SMALL = IngestSection(max_side=160, max_views=6, min_views=2)


def image(path, size=(8, 6), value=100, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    fill = (value,) * 3 if mode == "RGB" else value
    Image.new(mode, size, fill).save(path)


def agreement(fields, a=0, b=1):
    """Share of pixels of view a whose label agrees where they land in view b, at the same depth."""
    pixels = np.argwhere(np.isfinite(fields["depth"][a]))
    points = unproject(fields["depth"][a], fields["Ks"][a], fields["cam_from_world"][a], pixels)
    pose = fields["cam_from_world"][b]
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    seen = camera @ fields["Ks"][b].T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.floor(seen[:, :2] / seen[:, 2:]).T
    height, width = fields["depth"][b].shape
    inside = (camera[:, 2] > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = u[inside].astype(int), v[inside].astype(int)
    same = np.abs(fields["depth"][b][v, u] - camera[inside, 2]) < 0.02 * camera[inside, 2]
    first = fields["labels"][a][pixels[inside, 0], pixels[inside, 1]]
    return same.mean(), (first == fields["labels"][b][v, u])[same].mean()


@pytest.mark.data
def test_house_kitchen_poses_depth_and_labels_agree_between_views():
    folder = data("house_kitchen")
    assert common.detect(folder) == "colmap"
    assert colmap.probe(folder) == {"poses": True, "depth": True, "labels": True}
    fields = colmap.read(folder, IngestSection(max_side=320, max_views=20))
    best = max((agreement(fields, 0, k) for k in range(1, 20)), key=lambda pair: pair[0])
    assert best[0] > 0.3
    assert best[1] > 0.95
    assert "void" not in fields["class_names"]
    assert fields["is_test"].sum() == 3


@pytest.mark.data
def test_fox_lists_absent_frames_and_is_undistorted():
    folder = data("fox")
    assert common.detect(folder) == "transforms"
    assert len(transforms.files(folder)) == 51
    fields = transforms.read(folder, SMALL)
    assert fields["images"].shape[0] == 6
    assert any("17 of 67" in note for note in fields["source"]["notes"])
    assert any("undistorted" in note for note in fields["source"]["notes"])
    assert np.allclose(fields["Ks"][:, 0, 0] / 160, 1375.52 / 1920, rtol=0.05)


@pytest.mark.data
def test_statue_with_images_of_several_sizes_is_padded_and_masked():
    folder = data("statue_colmap") / "dense/0"
    fields = colmap.read(folder, SMALL)
    assert fields["images"].shape[0] == 6
    assert not fields["loss_mask"].all()
    assert (fields["images"][~fields["loss_mask"]] == 0).all()


def write_transforms(folder, n=3, **changes):
    frames = []
    for k in range(n):
        image(folder / f"images/frame_{k + 9}.png", value=20 * k)
        matrix = np.eye(4)
        matrix[0, 3] = k
        frames.append({"file_path": f"images/frame_{k + 9}", "transform_matrix": matrix.tolist()})
    document = {"w": 8, "h": 6, "fl_x": 10.0, "cx": 4, "cy": 3, "frames": frames} | changes
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def test_opengl_cameras_become_opencv_and_names_sort_naturally(tmp_path):
    fields = transforms.read(write_transforms(tmp_path), SETTINGS)
    assert fields["names"] == ["frame_9", "frame_10", "frame_11"]
    assert np.allclose(fields["cam_from_world"][1][:3, :3], np.diag([1, -1, -1]))
    assert np.allclose(fields["cam_from_world"][1][:3, 3], [-1, 0, 0])
    assert fields["images"][2, 0, 0, 0] == 40


def test_a_pose_that_is_not_finite_is_dropped_with_a_note(tmp_path):
    folder = write_transforms(tmp_path, 4)
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][0]["transform_matrix"][0][3] = float("inf")
    (folder / "transforms.json").write_text(json.dumps(document))
    fields = transforms.read(folder, SETTINGS)
    assert len(fields["names"]) == 3
    assert "not finite" in fields["source"]["notes"][0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "no frames"),
        ({"frames": [{"file_path": "a"}]}, "transform_matrix"),
        ({"frames": [{"file_path": "images/frame_9", "transform_matrix": [[1]]}]}, r"not \(4, 4\)"),
        ({"fl_x": 10.0, "k3": 0.1}, "undistort"),
        ({"w": 9}, "restore"),
    ],
)
def test_bad_transforms_are_named(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        transforms.read(write_transforms(tmp_path, **changes), SETTINGS)


def test_transforms_without_focal_length_or_syntax_are_named(tmp_path):
    folder = write_transforms(tmp_path)
    document = json.loads((folder / "transforms.json").read_text())
    del document["fl_x"]
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="camera_angle_x"):
        transforms.read(folder, SETTINGS)
    (folder / "transforms.json").write_text("{")
    with pytest.raises(InputError, match="does not parse"):
        transforms.read(folder, SETTINGS)


def test_too_few_frames_are_a_failure_that_counts_them(tmp_path):
    folder = write_transforms(tmp_path)
    (folder / "images/frame_9.png").unlink()
    (folder / "images/frame_10.png").unlink()
    with pytest.raises(DataFailure, match="2 of 3 listed frames are absent"):
        transforms.read(folder, SETTINGS)


def write_colmap(folder, model="PINHOLE 8 6 10 10 4 3", names=("a.png", "b.png", "c.png")):
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "sparse/0/cameras.txt").write_text(f"1 {model}\n")
    rows = [f"{k + 1} 1 0 0 0 {k} 0 0 1 {name}\n\n" for k, name in enumerate(names)]
    (folder / "sparse/0/images.txt").write_text("".join(rows))
    (folder / "sparse/0/points3D.txt").write_text("")
    for name in names:
        image(folder / "images" / name)
        image(folder / "depth" / name, mode="I;16", value=1500)
        image(folder / "semantic" / name, mode="L", value=7)
    (folder / "labels.json").write_text(json.dumps({"7": "sofa", "8": "void"}))
    return folder


def test_a_colmap_text_model_with_depth_and_labels_reads(tmp_path):
    folder = write_colmap(tmp_path)
    image(folder / "semantic/b.png", mode="L", value=8)
    fields = colmap.read(folder, SETTINGS)
    assert np.allclose(fields["depth"], 1.5)
    assert fields["class_names"] == ["sofa"]
    assert [int(v[0, 0]) for v in fields["labels"]] == [0, -1, 0]
    assert fields["cam_from_world"][2][0, 3] == 2
    assert len(colmap.files(folder)) == 3 + 1 + 9


def test_images_that_model_and_disk_do_not_share_are_counted(tmp_path):
    folder = write_colmap(tmp_path)
    (folder / "images/a.png").unlink()
    image(folder / "images/z.png")
    fields = colmap.read(folder, SETTINGS)
    assert len(fields["names"]) == 2
    assert len(fields["source"]["notes"]) == 2


def test_a_mask_becomes_a_loss_mask(tmp_path):
    folder = write_colmap(tmp_path)
    for name in ("a", "b", "c"):
        image(folder / f"masks/{name}.png", mode="L", value=255 * (name != "b"))
    masks = colmap.read(folder, SETTINGS)["loss_mask"]
    assert masks.mean((1, 2)).tolist() == [1, 0, 1]


def test_distorted_cameras_undistort_labels_and_depth_too(tmp_path):
    fields = colmap.read(write_colmap(tmp_path, "SIMPLE_RADIAL 8 6 10 4 3 0.05"), SETTINGS)
    assert np.nanmin(fields["depth"]) == 1.5
    assert fields["labels"].max() == 0
    assert fields["images"].shape == (*fields["labels"].shape, 3)


def test_an_unsupported_camera_model_is_named(tmp_path):
    with pytest.raises(InputError, match="OPENCV_FISHEYE"):
        colmap.read(write_colmap(tmp_path, "OPENCV_FISHEYE 8 6 10 10 4 3 0 0 0 0"), SETTINGS)


@pytest.mark.parametrize("damage", ["truncated image", "depth of another size", "no images", "no model"])
def test_a_damaged_colmap_source_is_named(tmp_path, damage):
    import shutil

    folder = write_colmap(tmp_path)
    if damage == "truncated image":
        file = folder / "images/b.png"
        file.write_bytes(file.read_bytes()[:-30])
    elif damage == "depth of another size":
        image(folder / "depth/b.png", (4, 3), 1500, "I;16")
    else:
        shutil.rmtree(folder / ("images" if damage == "no images" else "sparse"))
    with pytest.raises(InputError, match=str(folder)):
        colmap.read(folder, SETTINGS)


def test_photos_have_no_poses_and_mixed_sizes_are_masked(tmp_path):
    for k, size in enumerate([(80, 60), (60, 80), (40, 30)]):
        image(tmp_path / f"{k}.jpg", size)
    assert common.detect(tmp_path) == "photos"
    fields = photos.read(tmp_path, SETTINGS)
    assert fields["cam_from_world"] is None
    assert fields["images"].shape == (3, 80, 80, 3)
    assert fields["loss_mask"].sum() == 80 * 60 * 2 + 40 * 30
    assert fields["Ks"][0][0, 0] == pytest.approx(1.2 * 80)
    assert photos.probe(tmp_path)["poses"] is False


def test_images_are_reduced_but_never_enlarged(tmp_path):
    for k in range(3):
        image(tmp_path / f"{k}.jpg", (320, 160))
    fields = photos.read(tmp_path, SETTINGS)
    assert fields["images"].shape == (3, 80, 160, 3)
    assert fields["Ks"][0][0, 0] == pytest.approx(1.2 * 160)
    assert photos.read(tmp_path, IngestSection(max_side=9999))["images"].shape == (3, 160, 320, 3)


def test_nice_slam_layout_reads(tmp_path):
    folder = tmp_path / "office0"
    for k in range(3):
        image(folder / f"results/frame{k:06d}.jpg")
        image(folder / f"results/depth{k:06d}.png", mode="I;16", value=13107)
    (folder / "traj.txt").write_text("1 0 0 2 0 1 0 0 0 0 1 0 0 0 0 1\n" * 3)
    camera = {"w": 8, "h": 6, "fx": 10, "fy": 10, "cx": 3.5, "cy": 2.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    assert common.detect(folder) == "replica"
    fields = replica.read(folder, SETTINGS)
    assert np.allclose(fields["depth"], 2.0)
    assert fields["Ks"][0][0, 2] == 4.0
    assert fields["cam_from_world"][0][0, 3] == -2
    assert "labels" not in fields
    (folder / "traj.txt").write_text("1 0 0 2 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2)
    with pytest.raises(InputError, match="2 poses for 3 images"):
        replica.read(folder, SETTINGS)


def test_semantic_nerf_layout_reads_and_joins_on_number(tmp_path):
    folder = tmp_path / "office_0"
    for k in range(11):
        image(folder / f"Sequence_1/rgb/rgb_{k}.png", value=k)
        image(folder / f"Sequence_1/depth/depth_{k}.png", mode="I;16", value=1000 + k)
        image(folder / f"Sequence_1/semantic_class/semantic_class_{k}.png", mode="L", value=k % 3)
    rows = [f"1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1\n" for k in range(11)]
    (folder / "Sequence_1/traj_w_c.txt").write_text("".join(rows))
    classes = [{"id": 1, "name": "wall"}, {"id": 2, "name": "floor"}]
    (folder / "info_semantic.json").write_text(json.dumps({"classes": classes}))
    fields = replica.read(folder, SETTINGS)
    assert fields["images"][10, 0, 0, 0] == 10
    assert fields["depth"][10, 0, 0] == pytest.approx(1.010)
    assert fields["cam_from_world"][10][0, 3] == -10
    assert fields["class_names"] == ["wall", "floor"]
    assert fields["labels"][:3, 0, 0].tolist() == [-1, 0, 1]
    assert fields["Ks"][0][0, 2] == 4.0


def test_a_folder_without_photos_is_no_source(tmp_path):
    with pytest.raises(InputError, match=r"transforms\.json"):
        common.detect(tmp_path)
