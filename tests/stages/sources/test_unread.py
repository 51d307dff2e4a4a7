"""What lies beside photos and is not read is counted, with what to do about it."""

import pytest
from source_folders import image, model_of

from chebsplat.errors import InputError
from chebsplat.pipelines.planning.needs import source_sentence
from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import common


def test_raw_photos_and_videos_beside_photos_are_counted_in_notes_and_plan(tmp_path):
    for k in range(3):
        image(tmp_path / f"{k}.jpg")
    for name in ("IMG_1.CR2", "IMG_2.cr2", "walk.MP4", ".hidden.mp4", "notes.txt"):
        (tmp_path / name).write_bytes(b"\0")
    source = SourceSection(kind="photos", path=str(tmp_path))
    model = model_of([str(k) for k in range(3)], [(8, 6)] * 3, [None] * 3)
    note = ingest.read("scene", source, IngestSection(min_views=2), model)["source"]["notes"][-1]
    assert note.startswith(
        "2 .cr2, 1 .mp4 not read; convert to JPEG, for example with `darktable-cli a.cr2 a.jpg`"
    )
    assert "a video is read by itself" in note
    assert f"({note[:-1]})" in source_sentence("scene", source, source)
    assert common.unread(tmp_path / "absent") == ""


@pytest.mark.parametrize(("names", "remedy"), [
    (["a.webp"], "convert to JPEG, for example with `"),
    (["a.mov", "b.mp4"], "a video is read by itself"),
    (["images/a.mp4"], "a video is read by itself"),
])  # fmt: skip
def test_a_folder_of_what_is_not_read_says_what_to_do(tmp_path, names, remedy):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"\0")
    with pytest.raises(InputError, match=f"not read; {remedy}"):
        common.detect(tmp_path)
