"""HEIC photos are read as JPEGs are, where the extra is installed; blurred photos are named."""

import sys

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import uniform_filter1d, zoom
from shared import data
from source_folders import alone, image

from chebsplat.errors import InputError
from chebsplat.formats import images
from chebsplat.photos.frames import blurred, detail
from chebsplat.pipelines.planning.needs import media_packages
from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import common, photos

HEADER = b"\0\0\0\x18ftypheic\0\0\0\0" + bytes(16)


def heic(path, size=(96, 64), turn=1, focal=26):
    """Red at the top left, otherwise black, as the camera stores it."""
    package = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    package.register_heif_opener(thumbnails=False)
    exif = Image.Exif()
    exif[images.ORIENTATION] = turn
    exif.get_ifd(images.SUBSECTION)[images.FOCAL_35] = focal
    picture = Image.new("RGB", size)
    picture.paste((255, 0, 0), (0, 0, size[0] // 2, size[1] // 2))
    picture.save(path, "HEIF", exif=exif.tobytes(), quality=95)
    return path


def test_orientation_and_focal_length_count_as_in_a_jpeg(tmp_path):
    for name in ("a.heic", "b.HEIC", "c.jpg"):  # the last one lies about what it is
        heic(tmp_path / name, turn=6)
    assert common.detect(tmp_path) == "photos"
    fields = alone(tmp_path)
    assert fields["images"].shape == (3, 96, 64, 3)
    # it was turned clockwise
    assert fields["images"][0, 10, 50, 0] > 200 > 50 > fields["images"][0, 10, 10, 0]
    assert fields["Ks"][0, 0, 0] == pytest.approx(96 * 26 / 36)
    assert media_packages(photos.files(tmp_path)) == ("pillow_heif",)


def test_without_the_extra_a_heic_photo_is_one_line_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(HEADER)
    for read in (images.header, images.read_rgb, lambda path: media_packages([path])):
        with pytest.raises(
            InputError, match=r"a\.heic is a HEIC photo, which needs the extra `heic`: .*\[heic\]"
        ) as raised:
            read(tmp_path / "a.heic")
        assert raised.value.exit_code == 3 and "\n" not in str(raised.value)
    assert media_packages([image(tmp_path / "b.heic.png")]) == ()


def test_a_damaged_heic_is_named(tmp_path):
    whole = heic(tmp_path / "a.heic").read_bytes()
    for content in (
        HEADER,
        whole[:100],
        whole[: len(whole) // 2],
        b"",
        b"text",
        whole[:60] + bytes(200),
    ):
        (tmp_path / "a.heic").write_bytes(content)
        with pytest.raises(
            InputError,
            match=r"a\.heic is (not a readable|no PNG, JPEG or HEIC) "
            r"image",
        ):
            images.read_rgb(tmp_path / "a.heic")


def textured(n, seed=0):
    rng = np.random.default_rng(seed)
    return [
        zoom(rng.uniform(0, 255, (30, 40)), 4, order=1) + rng.uniform(0, 60, (120, 160))
        for _ in range(n)
    ]


def test_blur_is_told_from_plain_walls():
    views = textured(9)
    # moved, of little contrast
    views += [uniform_filter1d(views[0], 9, axis=1), 0.1 * views[1] + 100]
    found = blurred(np.array([detail(view) for view in views]))
    assert np.flatnonzero(found).tolist() == [9]
    assert not blurred(
        np.array([detail(uniform_filter1d(view, 9, axis=1)) for view in views[:9]])
    ).any()
    assert not blurred(np.array([detail(np.zeros((2, 2))), detail(np.zeros((8, 8)))])).any()


def test_blurred_photos_are_counted_and_named():
    stack = np.stack([np.repeat(view[..., None], 3, -1) for view in textured(30)]).clip(0, 255)
    stack[3:26] = stack[3:26].mean(0)  # nothing but what they share
    fields = {"names": [f"v{k}" for k in range(30)], "images": stack.astype(np.uint8)}
    assert ingest.blur_note(fields) == ""  # most are alike
    stack = np.concatenate([stack[:3], stack[26:], uniform_filter1d(stack[:2], 15, axis=2)])
    fields = {"names": [f"v{k}" for k in range(9)], "images": stack.astype(np.uint8)}
    assert ingest.blur_note(fields) == (
        "2 of 9 views look blurred: v7, v8; they are used as they are."
    )


@pytest.mark.data
@pytest.mark.parametrize(("name", "kind", "least", "most"), [("redkitchen", "seven_scenes", 8, 16),
                                                             ("house_kitchen", "colmap", 0,
                                                              0)])  # fmt: skip
def test_a_hand_held_sensor_has_blurred_frames_and_a_rendered_house_none(name, kind, least, most):
    fields = ingest.read(name, SourceSection(kind=kind, path=str(data(name))), IngestSection())
    n = int((ingest.blur_note(fields) or "0").split()[0])
    assert least <= n <= most
