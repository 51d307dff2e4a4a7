"""What a lens bends in plain photos is estimated from them and undone."""

import numpy as np
import pytest
from shared import data

from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import photos
from chebsplat.stages.sources.cameras import Camera
from chebsplat.stages.sources.common import Frame


def frames_of(folder, cameras):
    return [Frame(f"{k:02d}", folder / f"{k:02d}.png", camera) for k, camera in enumerate(cameras)]


def simple(width, height, focal):
    return Camera("SIMPLE_PINHOLE", (focal, width / 2, height / 2), width, height)


def test_the_corner_moves_as_the_model_says():
    found = photos.Lens(1.2, -0.1, 0.5)
    camera = photos._bent(simple(1000, 750, 1200.0), found).colmap
    corner = np.array([500.0, 375.0]) / 1200
    moved = np.asarray(camera.img_from_cam(np.array([[*corner, 1.0]])))[0] - [500, 375]
    assert photos.corner_shift(found, 1000, 750) == pytest.approx(625 - np.linalg.norm(moved), rel=1e-6)


def test_photos_of_one_lens_share_it_either_way_up_and_others_keep_theirs(tmp_path, monkeypatch):
    monkeypatch.setattr(photos, "estimate", lambda frames, upright: photos.Lens(1.1, -0.08, 0.5))
    cameras = [simple(800, 600, 960.0)] * 9 + [simple(600, 800, 960.0), simple(800, 600, 500.0)]
    frames, note = photos.with_lens(frames_of(tmp_path, cameras), True)
    assert [frame.camera.model for frame in frames] == ["SIMPLE_RADIAL"] * 10 + ["SIMPLE_PINHOLE"]
    assert frames[0].camera.params == pytest.approx((880, 400, 300, -0.08))
    assert frames[9].camera.params == pytest.approx((880, 300, 400, -0.08))
    assert "bends 10 of 11 photos" in note


@pytest.mark.parametrize(
    ("found", "said"), [(None, "could not be estimated"), (photos.Lens(1.1, 0.001, 0.5), "is straight")]
)
def test_photos_stay_where_no_lens_is_found_or_it_is_straight(tmp_path, monkeypatch, found, said):
    monkeypatch.setattr(photos, "estimate", lambda frames, upright: found)
    given = frames_of(tmp_path, [simple(800, 600, 960.0)] * 8)
    frames, note = photos.with_lens(given, True)
    assert frames == given
    assert said in note


def test_few_or_small_photos_are_not_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr(photos, "estimate", lambda *_: pytest.fail("estimated"))
    for camera, n in ((simple(800, 600, 960.0), photos.LEAST - 1), (simple(300, 200, 360.0), 20)):
        assert photos.with_lens(frames_of(tmp_path, [camera] * n), True)[1] == ""


def bent(pixels, focal, k, cut):
    """A pinhole picture u8 [H, W, 3] of a focal length as a lens of this k sees it, borders cut off."""
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
    return np.stack([map_coordinates(pixels[..., c], at, order=1, mode="nearest") for c in range(3)], -1)


@pytest.mark.data
@pytest.mark.xdist_group("sfm")
def test_a_known_distortion_is_found_and_undone(tmp_path):
    """Photos whose own lens moves their corners by less than 1 % of its -0.15 r²."""
    from PIL import Image

    focal, cut = 687.5, 20
    for k, file in enumerate(sorted((data("fox") / "images").iterdir())[15:27]):
        small = Image.open(file).convert("RGB").resize((540, 960), Image.Resampling.BOX)
        Image.fromarray(bent(np.asarray(small), focal, -0.15, cut)).save(tmp_path / f"{k:02d}.png")
    fields = photos.read(tmp_path, IngestSection(max_side=460))
    (note,) = (note for note in fields["source"]["notes"] if note.startswith("The lens bends 12 of 12 photos"))
    k = float(note.split("k = ")[1].split(";")[0])
    assert k == pytest.approx(-0.15, abs=0.04)
    assert any("undistorted (SIMPLE_RADIAL)" in other for other in fields["source"]["notes"])
    straight = photos.read(tmp_path, IngestSection(max_side=460, lens="straight"))
    assert not any("undistorted" in other for other in straight["source"]["notes"])
