"""Photos from outside: two formats, told by content, of bounded size, whatever their names."""

import io
import os
import threading
import time

import numpy as np
import pytest
from malformed.edits import EPS, declared_png
from PIL import Image, ImageOps
from source_folders import alone, image

from chebsplat.errors import InputError
from chebsplat.formats import images
from chebsplat.formats.images import header, opened, read_rgb, seen_size, turned
from chebsplat.stages import channels
from chebsplat.stages.tools import get_teacher


@pytest.mark.parametrize("how", ["ingest", "channels", "check-teacher"])
def test_an_image_that_is_a_program_is_never_run(tmp_path, monkeypatch, how):
    """Pillow hands an EPS to Ghostscript, whatever the file is called."""
    tool, ran = tmp_path / "bin/gs", tmp_path / "ran"
    tool.parent.mkdir()
    tool.write_text(f"#!/bin/sh\ntouch {ran}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tool.parent), prepend=os.pathsep)
    folder = tmp_path / "photos"
    image(folder / "a.png")
    (folder / "b.png").write_bytes(EPS)
    read = {
        "ingest": lambda: alone(folder),
        "channels": lambda: list(channels.photos([folder / "b.png"])),
        "check-teacher": lambda: get_teacher.read_photo(folder / "b.png"),
    }[how]
    with pytest.raises(InputError, match=r"b\.png is no PNG, JPEG or HEIC"):
        read()
    assert not ran.exists()


def test_no_module_but_one_opens_images():
    from shared import ROOT

    layers = ("chebsplat", "formats", "stages", "pipelines")
    found = [path.relative_to(ROOT) for layer in layers for path in (ROOT / layer).rglob("*.py")
             if "Image.open(" in path.read_text()]  # fmt: skip
    # a SOG's images are arrays in an archive, and no photos
    assert [path.as_posix() for path in found] == ["formats/images.py", "formats/sog.py"]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns_a_picture_as_pillow_would(tmp_path, orientation):
    exif = Image.Exif()
    exif[images.ORIENTATION] = orientation
    pixels = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    with opened(tmp_path / "a.png") as found:
        wanted = ImageOps.exif_transpose(found)
        assert np.array_equal(np.asarray(turned(found)), np.asarray(wanted))
        assert seen_size(found) == wanted.size == header(tmp_path / "a.png")[0]
    assert np.array_equal(read_rgb(tmp_path / "a.png"), pixels)


def test_an_image_is_judged_by_its_header_before_a_pixel_is_decoded(tmp_path):
    (tmp_path / "a.png").write_bytes(declared_png(30_000, 30_000))
    for read in (header, read_rgb):
        with pytest.raises(InputError, match="64 megapixels"):
            read(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(declared_png(7000, 7000))
    assert header(tmp_path / "b.png")[0] == (7000, 7000)
    with pytest.raises(InputError, match=r"b\.png is not a readable image"):
        read_rgb(tmp_path / "b.png")


def test_a_phones_double_picture_opens_as_its_first(tmp_path):
    held = io.BytesIO()
    Image.new("RGB", (8, 6), (9, 9, 9)).save(
        held, "MPO", save_all=True, append_images=[Image.new("RGB", (8, 6))]
    )
    (tmp_path / "a.jpg").write_bytes(held.getvalue())
    assert read_rgb(tmp_path / "a.jpg").mean() == 9


def test_threads_decode_together_what_fits_and_wait_for_the_rest(tmp_path, monkeypatch):
    budget = images._PixelBudget()
    monkeypatch.setattr(images, "_BUDGET", budget)
    monkeypatch.setattr(budget, "_free", 100)
    for k in range(6):
        image(tmp_path / f"{k}.png", (8, 6))  # two of 48 pixels fit
    at_once, most, lock = [0], [0], threading.Lock()

    def decode(k):
        with opened(tmp_path / f"{k}.png"):
            with lock:
                at_once[0] += 1
                most[0] = max(most[0], at_once[0])
            time.sleep(0.02)
            with lock:
                at_once[0] -= 1

    threads = [threading.Thread(target=decode, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert most[0] == 2 and budget._free == 100


def test_a_damaged_image_gives_its_pixels_back_to_the_budget(tmp_path):
    before = images._BUDGET._free
    image(tmp_path / "a.png", (80, 60))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-40])
    with pytest.raises(InputError, match="copy it again"):
        read_rgb(tmp_path / "a.png")
    assert images._BUDGET._free == before
