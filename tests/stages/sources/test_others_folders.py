"""Folders as other programs and people leave them: the photos, cameras and depth that are meant are
found, and said.
"""

import shutil

import numpy as np
import pytest
from source_folders import SETTINGS, alone, image, save, write_colmap

from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import colmap, colmap_model, common, photos

LARGE = IngestSection(max_side=640, min_views=2)


@pytest.mark.parametrize("names", [
    {"a.png": "a.PNG", "b.png": "b.jpg", "c.png": "c.JPEG"},
    {"left\\a.png": "left/a.png", "left\\b.png": "left/b.png", "right\\a.png": "right/a.png"},
    {"images/a.png": "a.png", "images/b.png": "b.png", "images/c.png": "c.png"},
    {"a.png": "2024/a.jpg", "b.png": "2024/b.jpg", "c.png": "2024/c.jpg"},
    {"data/cam1/a.tif": "cam1/a.jpg", "data/cam2/a.tif": "cam2/a.jpg",
     "data/cam2/b.tif": "cam2/b.jpg"},
    {"IMG.1.png": "IMG.1.JPG", "IMG.2.png": "IMG.2.JPG", "IMG.3.png": "IMG.3.JPG"},
])  # fmt: skip
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_photos_under_other_names_are_those_of_the_model_where_only_one_fits(tmp_path, names, form):
    """Greys tell which photo a view has, and places which pose."""
    folder = write_colmap(tmp_path, names=tuple(names))
    shutil.rmtree(folder / "images")
    shutil.rmtree(folder / "depth")
    shutil.rmtree(folder / "semantic")
    for k, new in enumerate(names.values()):
        image(folder / "images" / new, value=10 * k)
    if form == "bin":
        import pycolmap

        pycolmap.Reconstruction(folder / "sparse/0").write_binary(folder / "sparse/0")
    fields = colmap.read(folder, SETTINGS)
    assert len(fields["names"]) == 3
    for name, pixels, pose in zip(
        fields["names"], fields["images"], fields["cam_from_world"], strict=True
    ):
        k = [common.stem(new) for new in names.values()].index(name)
        assert abs(int(pixels[0, 0, 0]) - 10 * k) < 3 and pose[0, 3] == k


def test_photos_that_fit_two_names_are_none_and_a_message_shows_three_of_each_side(tmp_path):
    folder = write_colmap(tmp_path, names=tuple(f"x/{k}.png" for k in range(4)))
    shutil.rmtree(folder / "images")
    for k in range(4):
        image(folder / f"images/l/{k}.png")
        image(folder / f"images/r/{k}.png")
    with pytest.raises(DataFailure) as found:
        colmap.read(folder, SETTINGS)
    assert "absent on disk (x/0.png, x/1.png, x/2.png, ...)" in str(found.value)
    assert "(l/0.png, l/1.png, l/2.png, ...)" in str(found.value)


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize(("root", "sizes"), [("sparse", [2, 4, 3]), ("colmap/sparse", [3, 4])])
def test_the_largest_of_several_models_is_taken_and_the_others_are_named(
    tmp_path, root, sizes, form
):
    import pycolmap

    for number, size in enumerate(sizes):
        made = write_colmap(
            tmp_path / f"made{number}", names=tuple(f"{k}.png" for k in range(size))
        )
        (tmp_path / "scene" / root).mkdir(parents=True, exist_ok=True)
        shutil.copytree(made / "sparse/0", tmp_path / f"scene/{root}/{number}")
        if form == "bin":
            place = tmp_path / f"scene/{root}/{number}"
            pycolmap.Reconstruction(place).write_binary(place)
    shutil.copytree(tmp_path / "made1/images", tmp_path / "scene/images")
    assert common.detect(tmp_path / "scene") == "colmap"
    fields = colmap.read(tmp_path / "scene", SETTINGS)
    assert len(fields["names"]) == 4
    told = next(note for note in fields["source"]["notes"] if note.startswith("The largest model"))
    assert told.startswith(
        f"The largest model is taken, {root}/1 (4 images); left out: {root}/0 ({sizes[0]} images)"
    )


@pytest.mark.parametrize(("place", "camera", "K"), [
    ("images_4", "PINHOLE 640 480 500 510 320.5 240.5", [125, 127.5, 80.125, 60.125]),
    ("images", "PINHOLE 640 480 500 510 320.5 240.5", [125, 127.5, 80.125, 60.125]),
    ("images_2", "SIMPLE_PINHOLE 1280 960 1000 640 480", [125, 125, 80, 60]),
    ("input", "PINHOLE 160 120 125 125 80 60", [125, 125, 80, 60]),
    # not turned: another shape
    ("images", "PINHOLE 480 640 510 500 240 320", [125, 127.5, 80, 60]),
])  # fmt: skip
def test_cameras_are_scaled_to_photos_that_were_reduced_later(tmp_path, place, camera, K):
    folder = write_colmap(tmp_path, camera)
    for part in ("images", "depth", "semantic"):
        shutil.rmtree(folder / part)
    for name in "abc":
        image(folder / place / f"{name}.png", (160, 120))
    assert {folder / place / f"{name}.png" for name in "abc"} < set(colmap.files(folder))
    if camera.startswith("PINHOLE 480"):
        with pytest.raises(InputError, match=r"a\.png is 160x120"):
            colmap.read(folder, LARGE)
        return
    fields = colmap.read(folder, LARGE)
    found = fields["Ks"][0]
    np.testing.assert_allclose([found[0, 0], found[1, 1], found[0, 2], found[1, 2]], K)
    scaled = any("scaled to their photos" in note for note in fields["source"]["notes"])
    assert scaled == (place != "input")


def test_lidar_depth_of_fewer_pixels_is_looked_up_and_believed_where_it_is_sure(tmp_path):
    """A quarter of the photo's pixels a side; ARKit's confidence is 0, 1 or 2."""
    folder = write_colmap(tmp_path, "PINHOLE 64 48 50 50 32 24")
    depth = (1000 + np.arange(16 * 12)).reshape(12, 16).astype(np.uint16)
    sure = (np.arange(16 * 12).reshape(12, 16) % 3).astype(np.uint8)
    for name in "abc":
        (folder / f"depth/{name}.png").unlink()
        save(folder / f"depth/{name}.PNG", depth)
        save(folder / f"confidence/{name}.PNG", sure)
    found = colmap.read(folder, SETTINGS)["depth"][1]
    wanted = np.where(sure > 0, depth / 1000, np.nan).repeat(4, 0).repeat(4, 1)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert sum(path.parent.name == "confidence" for path in colmap.files(folder)) == 3


def test_points_whose_error_is_not_known_are_taken(tmp_path):
    rng = np.random.default_rng(0)
    tracks = np.stack([np.repeat(np.arange(150), 3), np.tile(np.arange(3), 150)], 1)
    errors = np.where(np.arange(150) < 120, np.nan, np.where(np.arange(150) < 140, -1.0, 9.0))
    cloud = colmap_model.Cloud(
        rng.normal(size=(150, 3)), np.zeros((150, 3), np.uint8), errors, tracks
    )
    notes = []
    fields = {
        "names": list("abc"),
        "cam_from_world": np.tile(np.eye(4), (3, 1, 1)),
        "source": {"notes": notes},
    }
    found = colmap.points_of(cloud, list("abc"), fields)
    assert len(found["points"]) == 140 and notes[0].startswith("10 of the model's 150 points")
    cloud.errors[:] = 9
    assert colmap.points_of(cloud, list("abc"), fields) == {}
    assert notes[-1].startswith("0 points are left, fewer than 100: none is used")


def test_points_and_depth_in_empty_space_are_left_out(tmp_path):
    """The left half of all photos is transparent; every other point lies there."""
    folder = write_colmap(tmp_path, "PINHOLE 80 60 50 50 40 30")
    pixels = np.full((60, 80, 4), 200, np.uint8)
    pixels[:, :40, 3] = 0
    for name in "abc":
        save(folder / f"images/{name}.png", pixels)
    fields = colmap.read(folder, SETTINGS)
    assert np.isnan(fields["depth"][:, :, :40]).all() and (fields["labels"][:, :, :40] == -1).all()
    assert np.allclose(fields["depth"][:, :, 40:], 1.5) and (fields["labels"][:, :, 40:] == 0).all()
    shutil.rmtree(folder / "depth")
    rng = np.random.default_rng(0)
    rows = [
        f"{k} {rng.uniform(4, 8) * (-1) ** k} {rng.uniform(-2, 2)} 30 9 9 9 .5" for k in range(300)
    ]
    (folder / "sparse/0/points3D.txt").write_text("\n".join(rows))
    poses = "".join(
        f"{k + 1} 1 0 0 0 {0.1 * k} 0 0 1 {name}.png\n\n" for k, name in enumerate("abc")
    )
    (folder / "sparse/0/images.txt").write_text(poses)
    fields = colmap.read(folder, SETTINGS)
    assert len(fields["points"]) == 150 and (fields["points"][:, 0] > 0).all()
    assert "150 of 300 points lie in empty space and are left out." in fields["source"]["notes"]


@pytest.mark.parametrize(("paths", "names"), [
    (["cam1/1.jpg", "cam1/2.jpg", "cam2/1.jpg"], ["cam1/1", "cam1/2", "cam2/1"]),
    (["input/1.jpg", "input/2.jpg", "masks/1.png"], ["1", "2"]),
    (["images/1.jpg", "images/2.jpg", "images_2/1.jpg"], ["1", "2"]),
    (["images_4/1.jpg", "images_4/2.jpg", "depth/1.png"], ["1", "2"]),
])  # fmt: skip
def test_photos_alone_are_found_in_the_folders_that_others_put_them_in(tmp_path, paths, names):
    for path in paths:
        image(tmp_path / path, value=255)
    assert common.detect(tmp_path) == "photos"
    assert alone(tmp_path)["names"] == names
    assert len(photos.files(tmp_path)) == len(names) + ("masks/1.png" in paths)


def test_masks_beside_photos_are_used(tmp_path):
    for k in range(3):
        image(tmp_path / f"{k}.jpg")
    image(tmp_path / "masks/0.png", mode="L", value=0)
    image(tmp_path / "masks/1.jpg.png", mode="L", value=255)
    fields = alone(tmp_path)
    assert fields["loss_mask"].mean((1, 2)).tolist() == [0, 1, 1]
    assert "1 of 3 views have no mask; all their pixels count." in fields["source"]["notes"]
