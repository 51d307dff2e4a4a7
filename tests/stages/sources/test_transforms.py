"""What transforms.json may say besides poses is used, or named as not used."""

import json

import layouts
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData, PlyElement
from source_folders import SETTINGS, change_frame, image, save, write_transforms

from chebsplat.errors import InputError
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import common, scannet, seven_scenes, transforms

LENS = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": 0.002}
BROWN = [200, 210, 120, 90, -0.2, 0.05, 0.001, 0.002, 0.01, 0, 0, 0]


@pytest.mark.parametrize(("values", "model", "params"), [
    (LENS | {"k3": 0.01}, "FULL_OPENCV", BROWN),
    ({"distortion_params": [-0.2, 0.05, 0.01, 0, 0.001, 0.002]}, "FULL_OPENCV", BROWN),
    ({"distortion_params": [-0.2, 0.05, 0, 0, 0.001, 0.002], "k1": 9}, "OPENCV", BROWN[:8]),
    (LENS | {"k3": 0.01, "k4": 0.02, "k5": 0.03, "k6": 0.004, "camera_model": "FULL_OPENCV"},
     "FULL_OPENCV",
     [*BROWN[:9], 0.02, 0.03, 0.004]),
    ({"k1": 0.01, "k2": 0.002, "k3": 0.001, "k4": 1e-4, "camera_model": "OPENCV_FISHEYE"},
     "OPENCV_FISHEYE",
     [200, 210, 120, 90, 0.01, 0.002, 0.001, 1e-4]),
    ({"k1": 0.01, "is_fisheye": True}, "OPENCV_FISHEYE", [200, 210, 120, 90, 0.01, 0, 0, 0]),
])  # fmt: skip
def test_every_lens_that_can_be_written_is_undone(tmp_path, values, model, params):
    """Photos whose value is their own coordinate: pycolmap says where each of our pixels lies in
    them.
    """
    folder = write_transforms(tmp_path, w=240, h=180, fl_x=200, fl_y=210, cx=120, cy=90, **values)
    ys, xs = np.mgrid[:180, :240]
    for path in (folder / "images").iterdir():
        save(path, np.stack([xs, ys, 0 * xs], -1).astype(np.uint8))
    fields = transforms.read(folder, IngestSection(max_side=400))
    height, width = fields["images"].shape[1:3]
    pixels = np.stack(
        [*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), np.ones((height, width))],
        -1,
    )
    camera = pycolmap.Camera(model=model, width=240, height=180, params=params)
    at = camera.img_from_cam(pixels.reshape(-1, 3) @ np.linalg.inv(fields["Ks"][0]).T).reshape(
        height, width, 2
    )
    inner = np.s_[3:-3, 3:-3]
    assert np.abs(fields["images"][0, ..., :2] + 0.5 - at)[inner].max() < 1


@pytest.mark.parametrize(("lists", "tests", "names"), [
    ({"train_filenames": [0, 1], "val_filenames": [2], "test_filenames": [2]}, [2], [0, 1, 2]),
    ({"train_filenames": [0], "val_filenames": [1], "test_filenames": [3]}, [1, 3], [0, 1, 3]),
    ({"train_filenames": [0, 2]}, [1, 3], [0, 1, 2, 3]),
    ({"test_filenames": [1]}, [1], [0, 1, 2, 3]),
])  # fmt: skip
def test_lists_of_nerfstudio_are_the_split(tmp_path, lists, tests, names):
    paths = [f"images/frame_{k + 9}.png" for k in range(4)]
    folder = write_transforms(
        tmp_path, 4, **{key: [paths[k] for k in rows] for key, rows in lists.items()}
    )
    fields = transforms.read(folder, SETTINGS)
    assert fields["names"] == [f"frame_{k + 9}" for k in names]
    assert [names[k] for k in np.flatnonzero(fields["is_test"])] == tests
    left_out = any("1 frames are in no list" in note for note in fields["source"]["notes"])
    assert left_out == (len(names) == 3)
    with pytest.raises(InputError, match="test_filenames is no list of paths"):
        transforms.read(write_transforms(tmp_path, 4, test_filenames="a.png"), SETTINGS)


@pytest.mark.parametrize(
    ("parts", "tests"), [("train test val", ["test/r_0"]), ("train val", ["val/r_0"])]
)
def test_documents_of_blender_are_training_and_test_views(tmp_path, parts, tests):
    """Paths without an ending, an angle for all, transparency for the background, and rows of 3 by
    4.
    """
    for k, part in enumerate(parts.split()):
        frames = []
        for number in range(3 if part == "train" else 1):
            pixels = np.full((6, 8, 4), 200, np.uint8)
            pixels[:, :4, 3], pixels[:, 4:, 3] = 0, 255
            save(tmp_path / f"{part}/r_{number}.png", pixels)
            matrix = np.eye(4)[:3]
            matrix[0, 3] = 10 * k + number
            frames.append(
                {
                    "file_path": f"./{part}/r_{number}",
                    "rotation": 0.1,
                    "transform_matrix": matrix.tolist(),
                }
            )
        document = {"camera_angle_x": np.pi / 2, "frames": frames}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(document))
    assert common.detect(tmp_path) == "transforms"
    fields = transforms.read(tmp_path, SETTINGS)
    assert [n for n, test in zip(fields["names"], fields["is_test"], strict=True) if test] == tests
    assert sorted(fields["names"]) == sorted(["train/r_0", "train/r_1", "train/r_2", *tests])
    assert np.allclose(fields["Ks"][:, 0, 0], 4) and (fields["images"][:, :, :4] == 0).all()
    assert fields["cam_from_world"][fields["names"].index("train/r_2")][0, 3] == -2
    assert any(note == "Not read: transforms_val.json." for note in fields["source"]["notes"]) == (
        "test" in parts
    )
    assert len(transforms.files(tmp_path)) == 2 + 4


def write_cloud(path, n):
    rows = np.zeros(
        n, [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    )
    rows["x"], rows["red"] = np.arange(n), 9
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def test_points_that_a_document_names_are_taken_and_absent_or_few_ones_said(tmp_path):
    folder = write_transforms(tmp_path, ply_file_path="sparse_pc.ply")
    assert (
        "ply_file_path of transforms.json is absent on disk."
        in transforms.read(folder, SETTINGS)["source"]["notes"]
    )
    write_cloud(folder / "sparse_pc.ply", 120)
    fields = transforms.read(folder, SETTINGS)
    assert (
        fields["points"][:, 0].tolist() == list(range(120))
        and (fields["point_colors"] == [9, 0, 0]).all()
    )
    assert folder / "sparse_pc.ply" in transforms.files(folder)
    write_cloud(folder / "sparse_pc.ply", 12)
    fields = transforms.read(folder, SETTINGS)
    assert "points" not in fields and "holds 12 points, too few" in fields["source"]["notes"][-1]


def test_what_is_not_used_is_named(tmp_path):
    folder = change_frame(write_transforms(tmp_path, aabb_scale=4, skew=0.5), time=0.2, sharpness=9)
    image(folder / "masks/frame_9.png", mode="L")
    notes = transforms.read(folder, SETTINGS)["source"]["notes"]
    assert notes == ["Not read of transforms.json: 'skew', 'time'.",
                     "masks/ is not used: transforms.json lists none (mask_path)."]  # fmt: skip


def test_photos_that_lie_elsewhere_or_were_reduced_are_found_and_cameras_scaled(tmp_path):
    folder = write_transforms(tmp_path, w=32, h=24, fl_x=40, cx=16, cy=12)
    (folder / "images").rename(folder / "images_4")
    fields = transforms.read(folder, SETTINGS)
    assert fields["names"] == ["frame_9", "frame_10", "frame_11"] and np.allclose(
        fields["Ks"][0][0], [10, 0, 4]
    )
    notes = " ".join(fields["source"]["notes"])
    assert "3 photos have another path" in notes and "Cameras of 3 views are scaled" in notes


def test_paths_of_another_machine_mean_the_photos_of_these_names(tmp_path):
    folder = write_transforms(tmp_path / "scene")
    for k, path in enumerate(
        ("/home/me/scene/images/frame_9.jpg", "C:\\scene\\images\\frame_10.png", "../frame_11")
    ):
        change_frame(folder, k, file_path=path)
    fields = transforms.read(folder, SETTINGS)
    assert [name.rsplit("/")[-1] for name in fields["names"]] == ["frame_9", "frame_10", "frame_11"]
    assert fields["images"][:, 0, 0, 0].tolist() == [0, 20, 40]
    assert len(transforms.files(folder)) == 4
    image(tmp_path / "frame_12.png")
    with pytest.raises(InputError, match="lies elsewhere"):
        transforms.read(change_frame(folder, 2, file_path="../frame_12.png"), SETTINGS)


def test_a_skew_of_intrinsics_is_said_not_to_be_used(tmp_path):
    from source_folders import tiny

    K = np.eye(4)
    K[:2, :3] = [[10, 0.25, 4], [0, 10, 3]]
    layouts.write_seven_scenes(tmp_path / "seven", tiny())
    layouts.write_text(tmp_path / "seven/camera-intrinsics.txt", layouts.matrix_text(K[:3, :3]))
    scene = tiny() | {"class_names": ["wall", "floor"]}
    layouts.write_scannet_sg(tmp_path / "scannet", scene)
    layouts.write_text(tmp_path / "scannet/intrinsic/intrinsic_color.txt", layouts.matrix_text(K))
    for module, folder in ((seven_scenes, "seven"), (scannet, "scannet")):
        notes = module.read(tmp_path / folder, SETTINGS)["source"]["notes"]
        assert any("has a skew of 0.25 pixels, which is not used" in note for note in notes)
