"""COLMAP models and photos become pinhole views of one size, and nothing vanishes without a
note.
"""

import json
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.ndimage import laplace
from shared import data, run_stage
from source_folders import SETTINGS, alone, image, save, write_colmap

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.photos.exposures import relit
from chebsplat.stages.measuring.image_quality import figures_as_taken
from chebsplat.stages.settings import IngestSection, PoseSection
from chebsplat.stages.sources import assembly, colmap, colmap_model, common, photos
from chebsplat.stages.sources.cameras import Camera
from chebsplat.views import View

SIZE, FOCAL = (240, 180), 200.0
MODELS = {
    "SIMPLE_RADIAL": f"{FOCAL} 120 90 {{}}",
    "RADIAL": f"{FOCAL} 120 90 {{}} 0.05",
    "OPENCV": f"{FOCAL} {FOCAL} 120 90 {{}} 0.05 0.002 -0.003",
}


def test_a_colmap_text_model_with_depth_and_labels_reads(tmp_path):
    folder = write_colmap(tmp_path)
    image(folder / "semantic/b.png", mode="L", value=8)
    fields = colmap.read(folder, SETTINGS)
    assert np.allclose(fields["depth"], 1.5)
    assert fields["class_names"] == ["sofa"]
    assert [int(v[0, 0]) for v in fields["labels"]] == [0, -1, 0]
    assert fields["cam_from_world"][2][0, 3] == 2
    assert len(colmap.files(folder)) == 3 + 1 + 9
    dtypes = {
        k: str(fields[k].dtype) for k in ("images", "Ks", "cam_from_world", "depth", "labels")
    }
    assert list(dtypes.values()) == ["uint8", "float64", "float64", "float32", "int16"]


def fine_and_coarse(width, height):
    """Stripes a pixel wide of ± 30 grey values, a variance of 900, over steps of 32 pixels of ±
    30.
    """
    x = np.tile(np.arange(width), (height, 1))
    grey = 128 + 30 * (2 * (x % 2) - 1) + 30 * (2 * (x // 32 % 2) - 1)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize(("max_side", "kept"), [(256, 1.0), (640, 1.0), (128, 0.5)])
def test_reduced_photos_keep_the_variance_that_is_coarser_than_their_pixels(
    tmp_path, max_side, kept
):
    Image.fromarray(fine_and_coarse(256, 64)).save(tmp_path / "a.png")
    frame = common.Frame(
        "a", tmp_path / "a.png", Camera("PINHOLE", (200.0, 200.0, 128.0, 32.0), 256, 64)
    )
    settings = IngestSection(min_views=1, max_side=max_side)
    fields = assembly.assemble(common.Listing("photos", [frame], upright=True), settings)
    assert fields["variance_kept"] == pytest.approx(kept, abs=1e-6)


def test_variance_is_compared_over_the_part_of_a_photo_that_a_view_shows(tmp_path):
    photo = fine_and_coarse(256, 64)
    photo[:, 128:] = 128  # and of the view, the left half
    at = np.stack(np.meshgrid(np.arange(128) + 0.5, np.arange(64) + 0.5))
    assert assembly.variance_kept(Image.fromarray(photo), photo[:, :128], at) == 1
    assert assembly.variance_kept(Image.fromarray(photo), np.full_like(photo[:, :128], 9), at) == 0
    assert assembly.variance_kept(Image.fromarray(np.full_like(photo, 9)), photo[:, :128], at) == 1


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_models_that_colmap_writes_today_read(tmp_path, suffix):
    options = pycolmap.SyntheticDatasetOptions()
    (
        options.num_rigs,
        options.num_cameras_per_rig,
        options.num_frames_per_rig,
        options.num_points3D,
    ) = 1, 2, 3, 20
    model = pycolmap.synthesize_dataset(options)
    place = tmp_path / "sparse/0"
    place.mkdir(parents=True)
    model.write_text(place) if suffix == "txt" else model.write_binary(place)
    assert any(path.name.startswith("frames") for path in place.iterdir())
    for view in model.images.values():
        camera = model.cameras[view.camera_id]
        image(tmp_path / "images" / view.name, (camera.width, camera.height))
    found = colmap_model.read_model(place)
    assert {view.name: view.pose[:3].tolist() for view in found.images} == {
        view.name: view.cam_from_world().matrix().tolist() for view in model.images.values()
    }
    points = {tuple(point.xyz): point for point in model.points3D.values()}
    assert len(found.cloud.means) == 20
    for row, (mean, color) in enumerate(zip(found.cloud.means, found.cloud.colors, strict=True)):
        point = points[tuple(mean)]
        assert color.tolist() == point.color.tolist()
        seen = found.cloud.tracks[found.cloud.tracks[:, 0] == row, 1]
        observers = {model.images[element.image_id].name for element in point.track.elements}
        assert {found.images[view].name for view in seen} == observers
    fields = colmap.read(tmp_path, IngestSection(max_side=64))
    expected = {common.stem(v.name): v.cam_from_world().matrix() for v in model.images.values()}
    assert set(fields["names"]) == set(expected) and len(expected) == 6
    for name, pose in zip(fields["names"], fields["cam_from_world"], strict=True):
        assert np.allclose(pose[:3], expected[name])


IMAGES = ["1 1 0 0 0 0 0 0 1 a.png", "2 1 0 0 0 1 0 0 1 b c.png", "3 1 0 0 0 2 0 0 1 0003"]
KEYPOINTS = "3 4 -1 5 6 -1 7 8 1 2 3 -1"  # 12 numbers: more words than an image has


@pytest.mark.parametrize("between", [
    ["", "", ""], [KEYPOINTS] * 3, ["", KEYPOINTS, ""], [None] * 3, [None, KEYPOINTS, None],
    ["# 3 keypoints"] * 3,
    [" # none", "", "  "], [f"# of a\n{KEYPOINTS}", "#", KEYPOINTS],
    ["1.5 2.5 -1\n\n # end", "\n", None],
])  # fmt: skip
def test_no_view_of_a_text_model_is_lost_whatever_follows_it(tmp_path, between):
    """Keypoints, an empty line, a comment, or nothing at all, as scripts that thin out a model
    leave it.
    """
    lines = ["#IMAGE_ID, ...", " # thinned"]
    lines += [
        part for pair in zip(IMAGES, between, strict=True) for part in pair if part is not None
    ]
    write_colmap(tmp_path)
    (tmp_path / "sparse/0/cameras.txt").write_text("1.0 PINHOLE 320.0 240.0 200 200 160 120\n")
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(lines))
    model = colmap_model.read_model(tmp_path / "sparse/0")
    assert [image.name for image in model.images] == ["a.png", "b c.png", "0003"]
    assert [image.pose[0, 3] for image in model.images] == [0, 1, 2]
    assert model.cameras[1][2:] == (320, 240)
    assert colmap_model.size_of(tmp_path / "sparse/0") == 3


def test_bytes_after_a_models_last_record_are_counted(tmp_path):
    """As COLMAP's own reader, which passes over them."""
    options = pycolmap.SyntheticDatasetOptions()
    (
        options.num_rigs,
        options.num_cameras_per_rig,
        options.num_frames_per_rig,
        options.num_points3D,
    ) = 1, 1, 4, 9
    pycolmap.synthesize_dataset(options).write_binary(tmp_path)
    with (tmp_path / "images.bin").open("ab") as stream:
        stream.write(b"ended")
    found, theirs = colmap_model.read_model(tmp_path), pycolmap.Reconstruction(tmp_path)
    assert {image.name for image in found.images} == {
        image.name for image in theirs.images.values()
    }
    assert found.notes == ("5 bytes follow the last record of images.bin and are not read.",)


LENSES = {
    "FULL_OPENCV": [200, 210, 120, 90, -0.2, 0.05, 0.001, 0.002, 0.01, 0, 0, 0],
    "OPENCV_FISHEYE": [200, 210, 120, 90, 0.01, 0.002, 0, 0], "FOV": [200, 210, 120, 90, 0.7],
    "SIMPLE_RADIAL_FISHEYE": [200, 120, 90, 0.02], "RADIAL_FISHEYE": [200, 120, 90, 0.02, 0.01],
    "THIN_PRISM_FISHEYE": [200, 210, 120, 90] + [0.01] * 8,
    "RAD_TAN_THIN_PRISM_FISHEYE": [200, 210, 120, 90] + [0.001] * 12,
    "SIMPLE_DIVISION": [200, 120, 90, -0.1], "DIVISION": [200, 210, 120, 90, -0.1],
    "SIMPLE_FISHEYE": [200, 120, 90], "FISHEYE": [200, 210, 120, 90],
    "EUCM": [200, 210, 120, 90, 0.6, 1.1],
}  # fmt: skip


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("lens", LENSES)
def test_every_lens_that_colmap_writes_is_undone(tmp_path, lens, suffix):
    """Photos whose value is their own coordinate: pycolmap says where each of our pixels lies in
    them.
    """
    if not hasattr(pycolmap.CameraModelId, lens):
        pytest.skip(f"this pycolmap has no {lens}")
    camera = pycolmap.Camera(camera_id=1, model=lens, width=240, height=180, params=LENSES[lens])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for k in range(3):
        image_of = pycolmap.Image(f"{k}.png", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image_of, pycolmap.Rigid3d())
        ys, xs = np.mgrid[:180, :240]
        save(tmp_path / f"images/{k}.png", np.stack([xs, ys, 0 * xs], -1).astype(np.uint8))
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_text(tmp_path / "sparse/0") if suffix == "txt" else model.write_binary(
        tmp_path / "sparse/0"
    )
    fields = colmap.read(tmp_path, IngestSection(max_side=400))
    height, width = fields["images"].shape[1:3]
    pixels = np.stack(
        [*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), np.ones((height, width))],
        -1,
    )
    at = camera.img_from_cam(pixels.reshape(-1, 3) @ np.linalg.inv(fields["Ks"][0]).T).reshape(
        height, width, 2
    )
    inner = np.s_[3:-3, 3:-3]
    found = fields["images"][0, ..., :2] + 0.5
    assert np.abs(found - at)[inner].max() < 1


def cloud_of(rng, n, n_views, length):
    """A model's cloud of points near the origin, each seen by `length` of its images."""
    views = (
        np.concatenate([rng.choice(n_views, length, replace=False) for _ in range(n)])
        if length
        else []
    )
    tracks = np.stack([np.repeat(np.arange(n), length), views], 1).astype(int)
    return colmap_model.Cloud(
        rng.normal(size=(n, 3)), np.zeros((n, 3), np.uint8), np.ones(n), tracks
    )


@pytest.mark.parametrize(("length", "n_kept"), [(0, 150), (2, 0), (4, 150)])
def test_points_that_enough_images_see_are_taken_and_those_without_any_tracks(length, n_kept):
    cloud = cloud_of(np.random.default_rng(0), 150, 6, length)
    notes = []
    given = {
        "names": list("abcd"),
        "cam_from_world": np.tile(np.eye(4), (4, 1, 1)),
        "source": {"notes": notes},
    }
    fields = colmap.points_of(cloud, list("fedcba"), given)
    assert len(fields.get("points", ())) == n_kept
    if length == 4:
        point, view = fields["tracks"].T
        expected = {(p, "abcdef"[5 - v]) for p, v in cloud.tracks.tolist() if 5 - v < 4}
        assert {
            (p, "abcd"[v]) for p, v in zip(point.tolist(), view.tolist(), strict=True)
        } == expected
        cloud.errors[:20] = 9
        few = colmap.points_of(cloud, list("fedcba"), given)
        assert len(few["points"]) == 130 and notes[0].startswith(
            "20 of the model's 150 points are left out"
        )
        assert few["tracks"][:, 0].max() < 130


def test_images_that_model_and_disk_do_not_share_are_counted(tmp_path):
    folder = write_colmap(tmp_path)
    (folder / "images/a.png").unlink()
    image(folder / "images/z.png")
    fields = colmap.read(folder, SETTINGS)
    assert fields["names"] == ["b", "c"]
    assert "labels" in fields
    assert fields["source"]["notes"] == [
        "1 of 3 images of the model are absent on disk (a.png).",
        "1 of 3 images on disk are not in the model and are left out (z.png)."]  # fmt: skip


def test_a_split_of_scene_json_does_not_move_with_max_views(tmp_path):
    names = tuple(f"{k}.png" for k in range(12))
    folder = write_colmap(tmp_path, names=names)
    (folder / "scene.json").write_text(json.dumps({"test_every": 4, "labels": {"7": "sofa"}}))
    assert np.flatnonzero(colmap.read(folder, SETTINGS)["is_test"]).tolist() == [0, 4, 8]
    fields = colmap.read(folder, IngestSection(max_views=5))
    assert [n for n, t in zip(fields["names"], fields["is_test"], strict=True) if t] == ["0", "8"]
    (folder / "scene.json").write_text(json.dumps({"test_every": 4, "frames": [{"file": "z.png"}]}))
    fields = colmap.read(folder, SETTINGS)
    assert "is_test" not in fields
    assert "not used" in fields["source"]["notes"][-1]


def test_a_mask_becomes_a_loss_mask(tmp_path):
    folder = write_colmap(tmp_path)
    image(folder / "masks/a.png", mode="L", value=255)
    image(folder / "masks/b.png.png", mode="RGB", value=0)
    fields = colmap.read(folder, SETTINGS)
    assert fields["loss_mask"].mean((1, 2)).tolist() == [1, 0, 1]
    assert "1 of 3 views have no mask" in fields["source"]["notes"][0]


@pytest.mark.parametrize(("model", "k"), [(m, k) for m in MODELS for k in (-0.3, 0.3)])
def test_undistortion_follows_the_polynomial_for_images_depth_and_labels(tmp_path, model, k):
    """Photos whose value is their own coordinate; the expected coordinate is written out here."""
    folder = write_colmap(tmp_path, f"{model} {SIZE[0]} {SIZE[1]} {MODELS[model].format(k)}")
    ys, xs = np.mgrid[: SIZE[1], : SIZE[0]]
    for name in "abc":
        save(folder / f"images/{name}.png", np.stack([xs, ys, 0 * xs], -1).astype(np.uint8))
        save(folder / f"depth/{name}.png", (1000 + xs).astype(np.uint16))
        save(folder / f"semantic/{name}.png", (ys // 20 + 1).astype(np.uint8))
    (folder / "labels.json").unlink()
    fields = colmap.read(folder, IngestSection(max_side=150))
    assert max(fields["images"].shape[1:3]) == 150
    height, width = fields["labels"].shape[1:]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    K = fields["Ks"][0]
    u, v = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    second, p1, p2 = {
        "SIMPLE_RADIAL": (0, 0, 0),
        "RADIAL": (0.05, 0, 0),
        "OPENCV": (0.05, 0.002, -0.003),
    }[model]
    r2 = u * u + v * v
    radial = 1 + k * r2 + second * r2 * r2
    u, v = (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
        v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v),
    )
    at_x, at_y = FOCAL * u + 120, FOCAL * v + 90  # photo pixels
    # Averaging and bilinear sampling of a ramp are exact inside; at the border they clamp to the
    # last pixel.
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(fields["images"][0, ..., 0] + 0.5 - at_x)[inner].max() < 1.5
    assert np.abs(fields["images"][0, ..., 1] + 0.5 - at_y)[inner].max() < 1.5
    assert np.abs((fields["depth"][0] - 1) * 1000 + 0.5 - at_x)[inner].max() < 0.51
    ids = np.array([int(name.removeprefix("class_")) for name in fields["class_names"]])[
        fields["labels"][0]
    ]
    whole = np.abs((at_y + 10) % 20 - 10) > 0.01  # off the edges of stripes
    assert (ids == np.floor(at_y / 20) + 1)[inner][whole[inner]].all()


STRAIGHT = ["SIMPLE_RADIAL 80 60 50 40.3 29.6 0", "RADIAL 80 60 50 40 30 0 0",
            "OPENCV 80 60 50 51 40 30 0 0 0 0",
            "OPENCV 80 60 50 50 40 30 1e-5 -2e-5 1e-6 0"]  # fmt: skip


@pytest.mark.parametrize("line", STRAIGHT)
def test_a_lens_that_bends_nothing_leaves_every_pixel_as_it_is(tmp_path, line):
    folder = write_colmap(tmp_path, line)
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    save(folder / "images/a.png", noise)
    fields = colmap.read(folder, SETTINGS)
    assert np.array_equal(fields["images"][0], noise)
    params = [float(value) for value in line.split()[3:]]
    focal = params[:2] if line.startswith("OPENCV") else [params[0]] * 2
    centre = params[2:4] if line.startswith("OPENCV") else params[1:3]
    assert fields["Ks"][0].tolist() == [
        [focal[0], 0, centre[0]],
        [0, focal[1], centre[1]],
        [0, 0, 1],
    ]
    assert "undistorted" not in str(fields["source"])


@pytest.mark.parametrize("k", [-0.1, 0.01, 0.1])
def test_where_a_lens_bends_nothing_pixels_stay_and_the_scale_too(tmp_path, k):
    """At the principal point: the view's pixel is the photo's there, and its focal length that of
    the photo.
    """
    folder = write_colmap(tmp_path, f"SIMPLE_RADIAL 80 60 90 40.3 29.6 {k}")
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    save(folder / "images/a.png", noise)
    fields = colmap.read(folder, SETTINGS)
    K = fields["Ks"][0]
    assert K[0, 0] == K[1, 1] == 90
    moved = K[:2, 2] - [40.3, 29.6]
    assert np.allclose(moved, moved.round())
    x, y = (int(v) for v in np.floor(K[:2, 2]))
    # splines of white noise
    assert np.abs(fields["images"][0, y, x].astype(int) - noise[29, 40]).max() <= 0.06 * 255
    assert fields["source"]["undistorted"] == ["SIMPLE_RADIAL"]


@pytest.mark.data
@pytest.mark.parametrize("side", [160, 480, 640, 1200, 8192])
@pytest.mark.parametrize(
    "photo",
    [
        "fox/images/0012.jpg",
        "captures/kitchen/images/13.jpg",
        "statue_colmap/dense/0/images/DSC_5283.jpg",
    ],
)
def test_undoing_a_lens_keeps_the_detail_of_a_photo(photo, side):
    """Variance of the Laplacian, against that of the photo reduced alike and otherwise as it is."""
    image = Image.open(data(photo.split("/")[0]) / photo.partition("/")[2]).convert("RGB")
    width, height = image.size
    camera = Camera(
        "SIMPLE_RADIAL", (1.2 * max(width, height), width / 2, height / 2, -0.05), width, height
    )
    view = assembly.geometry(camera, side)
    found = assembly.resampled(image, camera, view, assembly.positions(camera, view))
    size = [round(n * view.factor) for n in image.size]
    plain = np.asarray(
        image if size == list(image.size) else image.resize(size, Image.Resampling.BOX)
    )
    cut = [max((a - b) // 2, 0) + 4 for a, b in zip(plain.shape[:2], found.shape[:2], strict=True)]
    inner = plain[cut[0] : -cut[0], cut[1] : -cut[1]]
    kept, before = (
        laplace(pixels.mean(-1, dtype=float)).var() for pixels in (found[4:-4, 4:-4], inner)
    )
    assert 0.93 < kept / before < 1.3


@pytest.mark.data
@pytest.mark.parametrize("max_side", [160, 8192])
def test_test_photos_are_held_as_they_were_taken_and_measured_so(tmp_path, max_side):
    """The best picture there is of a scene, its undistorted photo, and that of a lens that is wrong
    by a fifth.
    """
    photo = Image.open(data("captures") / "kitchen/images/13.jpg").convert("RGB").resize((400, 300))
    folder = write_colmap(
        tmp_path / "source", "OPENCV 400 300 390 400 203.3 148 -0.2 0.05 0.002 -0.003"
    )
    for name in "abc":
        photo.save(folder / f"images/{name}.png")
    config = {"source": {"kind": "colmap", "path": str(folder)}, "ingest": {"max_side": max_side}}
    assert run_stage("ingest", tmp_path / "capture", config=config) == 0
    capture = Capture.read(tmp_path / "capture")
    tests = [name for name, is_test in zip(capture.names, capture.is_test, strict=True) if is_test]
    assert [lens[0] for lens in capture.lenses] == tests
    # at its own resolution, whatever is trained on
    np.testing.assert_array_equal(capture.taken[0], photo)
    views = {}
    for name, K in zip(capture.names, capture.Ks, strict=True):
        views[name] = View(torch.tensor(K).float(), torch.eye(4), *capture.size)

    def render(view, stops):
        picture = np.asarray(undistorted.resize((view.width, view.height)))
        return picture if stops is None else relit(picture, stops), None

    pictures = SimpleNamespace(render=render)
    undistorted = Image.fromarray(np.asarray(capture.images[0]))
    capture.taken = dict(enumerate(capture.taken))  # which gives one at a time alone
    as_they_are = dict.fromkeys(views)
    right = figures_as_taken(capture, pictures, views, as_they_are)
    assert right["size"] == [400, 300] and right["psnr"] > (30 if max_side > 400 else 20)
    darker = dict.fromkeys(views, np.full(3, -0.3))
    assert figures_as_taken(capture, pictures, views, darker)["psnr"] < right["psnr"] - 1
    capture.lenses[0][2][4] *= 1.2
    wrong = figures_as_taken(capture, pictures, views, as_they_are)
    assert wrong["psnr"] < right["psnr"] - (3 if max_side > 400 else 1)


def test_the_size_of_photos_as_taken_is_one_that_they_have():
    sizes, views = [(48, 32), (32, 48), (48, 32), (32, 48)], {}
    capture = SimpleNamespace(taken=[], lenses=[], loss_mask=None)
    for name, (width, height) in zip("abcd", sizes, strict=True):
        capture.taken.append(np.full((48, 48, 3), 90, np.uint8))
        capture.lenses.append([name, "PINHOLE", [40.0, 40.0, width / 2, height / 2], width, height])
        K = torch.tensor([[20.0, 0, width / 4], [0, 20, height / 4], [0, 0, 1]])
        views[name] = View(K, torch.eye(4), width // 2, height // 2)
    grey = SimpleNamespace(
        render=lambda view, stops: (np.full((view.height, view.width, 3), 90, np.uint8), None)
    )
    found = figures_as_taken(capture, grey, views, dict.fromkeys(views))
    assert (found["size"], found["psnr"], found["ssim"]) == ([48, 32], 100, pytest.approx(1))
    assert figures_as_taken(capture, grey, {}, {}) is None


def test_pixels_where_a_distortion_folds_back_do_not_count(tmp_path):
    """r (1 - 5 r^2) turns back at r = 1 / sqrt(15): 18 pixels of 70 from the centre."""
    fields = colmap.read(write_colmap(tmp_path, "SIMPLE_RADIAL 80 60 70 40 30 -5"), SETTINGS)
    height, width = fields["loss_mask"].shape[1:]
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    counted = np.hypot(x, y)[fields["loss_mask"][0]]
    assert 17 < counted.max() < 20  # the gradient is taken between neighbouring pixels


def test_focal_lengths_follow_each_side_as_it_was_rounded(tmp_path):
    fields = colmap.read(
        write_colmap(tmp_path, "SIMPLE_PINHOLE 101 37 50 50.5 18.5"), IngestSection(max_side=20)
    )
    assert fields["images"].shape == (3, 7, 20, 3)
    assert np.allclose(fields["Ks"][0], [[50 * 20 / 101, 0, 10], [0, 50 * 7 / 37, 3.5], [0, 0, 1]])


def test_labels_without_a_name_are_noted_and_class_names_can_be_given(tmp_path):
    folder = write_colmap(tmp_path)
    image(folder / "semantic/b.png", mode="L", value=9)
    image(folder / "semantic/c.png", mode="I;16", value=300)
    fields = colmap.read(folder, SETTINGS)
    assert fields["class_names"] == ["sofa", "lamp"]
    assert fields["labels"][:, 0, 0].tolist() == [0, 1, -1]
    assert "300" in fields["source"]["notes"][0]
    fields = colmap.read(folder, SETTINGS, ("lamp", "chair"))
    assert fields["class_names"] == ["lamp", "chair"]
    assert fields["labels"][:, 0, 0].tolist() == [-1, 0, -1]
    assert any("sofa" in note for note in fields["source"]["notes"])


def test_photos_of_mixed_sizes_are_masked(tmp_path):
    for k, size in enumerate([(80, 60), (60, 80), (40, 30)]):
        image(tmp_path / f"{k}.{'JPG' if k else 'jpeg'}", size)
    image(tmp_path / "thumbs/0.jpg")
    (tmp_path / "._0.jpg").write_bytes(b"not a photo")
    assert common.detect(tmp_path) == "photos"
    fields = alone(tmp_path)
    assert fields["images"].shape == (3, 80, 80, 3)
    assert fields["loss_mask"].sum() == 80 * 60 * 2 + 40 * 30
    assert fields["source"]["notes"][-2] == "Photos in these folders are not read: thumbs."
    assert photos.probe(tmp_path)["poses"] is False
    assert len(photos.files(tmp_path)) == 3


def test_exif_turns_a_photo_and_gives_its_focal_length(tmp_path):
    for k in range(3):
        exif = Image.Exif()
        exif[0x0112] = 6  # to be turned clockwise
        exif.get_ifd(0x8769)[0xA405] = 28 if k < 2 else 0
        pixels = np.zeros((60, 80, 3), np.uint8)
        pixels[:, :40] = 255
        Image.fromarray(pixels).save(tmp_path / f"{k}.jpg", exif=exif)
    fields = alone(tmp_path)
    assert fields["images"].shape == (3, 80, 60, 3)
    assert fields["images"][0, :30].min() > 200 and fields["images"][0, 50:].max() < 50
    assert np.allclose(fields["Ks"][:, 0, 0], [28 / 36 * 80, 28 / 36 * 80, 96])
    assert (
        "1 of 2 photos have no focal length"
        in photos.shots(tmp_path, PoseSection(), None, 1)[1][-1]
    )


def test_transparent_pixels_are_empty_and_count(tmp_path):
    """They are black, as a render of nothing is; half alpha is half of the colour; a photo of
    nothing says nothing.
    """
    for k, alpha in enumerate((255, 100, 0)):
        pixels = np.full((6, 8, 4), 255, np.uint8)
        pixels[:, :4, 3] = alpha
        pixels[:, 4:, 3] = 255 if k < 2 else 0
        save(tmp_path / f"{k}.png", pixels)
    fields = alone(tmp_path)
    assert fields["images"][:, 0, [0, 7], 0].tolist() == [[255, 255], [100, 255], [0, 0]]
    assert fields["loss_mask"].mean((1, 2)).tolist() == [1, 1, 0]
    assert (
        "2 of 3 photos have transparent pixels, which are empty space." in fields["source"]["notes"]
    )


def test_images_are_reduced_but_never_enlarged(tmp_path):
    for k in range(3):
        image(tmp_path / f"{k}.jpg", (320, 160))
    fields = alone(tmp_path)
    assert fields["images"].shape == (3, 80, 160, 3)
    assert fields["Ks"][0][0, 0] == pytest.approx(1.2 * 160)
    assert alone(tmp_path, IngestSection(max_side=8192))["images"].shape == (3, 160, 320, 3)


def test_depth_that_is_not_wanted_is_left_out_and_nothing_else(tmp_path):
    write_colmap(tmp_path / "source")
    made = []
    for depth in ("auto", "off"):
        config = {
            "source": {"kind": "colmap", "path": str(tmp_path / "source")},
            "ingest": {"depth": depth},
        }
        assert run_stage("ingest", tmp_path / depth, config=config) == 0
        made.append(Capture.read(tmp_path / depth))
    assert made[0].depth is not None and made[1].depth is None
    for field in ("images", "labels", "Ks", "cam_from_world", "is_test"):
        np.testing.assert_array_equal(getattr(made[0], field)[:], getattr(made[1], field)[:])
    assert read_manifest(tmp_path / "off").facts["left_out"] == {"depth": "ingest.depth is off"}
