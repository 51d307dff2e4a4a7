"""What lies beside photos and is not read is counted, with the command that converts it."""

import pytest
from source_folders import image

from chebsplat.errors import InputError
from chebsplat.pipelines.needs import source_sentence
from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import common


def test_heic_and_video_beside_photos_are_counted_in_notes_and_plan(tmp_path):
    for k in range(3):
        image(tmp_path / f"{k}.jpg")
    for name in ("IMG_1.HEIC", "IMG_2.heic", "walk.MP4", ".hidden.mp4", "notes.txt"):
        (tmp_path / name).write_bytes(b"\0")
    source = SourceSection(kind="photos", path=str(tmp_path))
    note = ingest.read("scene", source, IngestSection(min_views=2))["source"]["notes"][-1]
    assert note.startswith("2 .heic, 1 .mp4 not read; convert to JPEG, for example with `heif-convert a.heic a.jpg`")
    assert "`ffmpeg -i a.mp4" in note
    assert f"({note[:-1]})" in source_sentence("scene", source, source)
    assert common.unread(tmp_path / "absent") == ""


@pytest.mark.parametrize("name", ["a.mov", "a.HEIC", "images/a.mp4"])
def test_a_folder_of_video_or_heic_alone_says_what_to_do(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"\0")
    with pytest.raises(InputError, match=r"1 \.\w+ not read; convert to JPEG, for example with `"):
        common.detect(tmp_path)
