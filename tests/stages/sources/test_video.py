"""A video as a scene: frames that are sharp, evenly apart in what they see, named by their time."""

import sys

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, uniform_filter1d, zoom
from source_folders import model_of

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats import videos
from chebsplat.photos.frames import STEP, choose, progress, shifts
from chebsplat.pipelines.planning.needs import media_packages
from chebsplat.pipelines.planning.raw import raw_files
from chebsplat.pipelines.work import scenes
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import IngestSection, PoseSection
from chebsplat.stages.sources import assembly, common, video
from chebsplat.stages.sources.cameras import Camera
from chebsplat.stages.sources.common import file_of

RATE, SPEED = 30, 2  # frames/s, pixels a frame


def panorama():
    rng = np.random.default_rng(1)
    rough = zoom(rng.uniform(0, 255, (16, 80)), 8, order=1)
    return (
        gaussian_filter(rough + rng.uniform(-60, 60, rough.shape), 0.7)
        .clip(0, 255)
        .astype(np.uint8)
    )


def film(path, n=120, size=(192, 128), turn=0, blur=()):
    """A camera that pans to the right by SPEED pixels a frame."""
    av = pytest.importorskip("av", reason="the extra video is not installed")
    wide, (width, height) = panorama(), size
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=RATE)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = (
            width,
            height,
            "yuv420p",
            8_000_000,
        )
        if turn:
            stream.set_display_rotation(turn)
        for k in range(n):
            grey = wide[:height, SPEED * k : SPEED * k + width].astype(float)
            grey = uniform_filter1d(grey, 9, axis=1) if k in blur else grey
            frame = np.repeat(grey.astype(np.uint8)[..., None], 3, -1)
            frame[: height // 4, : width // 4] = 255, 0, 0
            out.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        out.mux(stream.encode())
    return path


def test_shifts_are_those_of_the_picture():
    wide = panorama()
    assert (shifts(wide[:128, 20:212], wide[:128, 13:205]) == [7, 0]).all()
    assert (shifts(np.zeros((64, 64)), np.zeros((64, 64))) == 0).all()


def test_trembling_is_no_progress_and_going_forward_is():
    shake = np.zeros((100, 9, 2))
    shake[1:, :, 0] = 0.02 * (-1.0) ** np.arange(99)[:, None]
    assert progress(shake)[-1] < 1
    y, x = np.mgrid[-1:2, -1:2].reshape(2, -1)
    outward = np.tile(0.01 * np.stack([x, y], 1), (100, 1, 1))  # the middle stays
    assert progress(outward)[-1] > 10
    assert (np.diff(progress(outward)) >= 0).all()


def test_of_each_step_the_sharpest_is_taken_and_never_too_many():
    steps, sharpness = np.arange(100) / 10, np.zeros(100)
    sharpness[[4, 16, 20]] = 1  # the last one lies at the edge of its step
    taken = choose(steps, sharpness, 50)
    assert len(taken) == 10 and list(taken[:2]) == [4, 16] and taken[2] != 20
    assert (np.diff(taken) > 0).all()
    assert len(choose(steps, sharpness, 4)) == 4


def test_frames_are_apart_sharp_in_order_and_the_same_again(tmp_path, capfd):
    blur = {k for k in range(120) if k % 4 != 1}
    file = film(tmp_path / "walk.mp4", blur=blur)
    assert common.detect(tmp_path) == common.detect(file) == "video"
    shots, notes = video.shots(tmp_path, PoseSection(), Progress(show=True), 1)
    assert shots == video.shots(file, PoseSection(), None, 1)[0]
    assert "frames 120/120" in capfd.readouterr().err and "frames are used" in notes[0]
    at = np.array([float(shot.name) for shot in shots]) * RATE
    assert not {round(k) for k in at} & blur
    # pixels are whole
    assert (np.diff(at) * SPEED / 192 < 2 * STEP).all() and len(at) > 120 * SPEED / 192 / STEP - 3
    names = [shot.name for shot in shots]
    assert names == sorted(names)
    finer = video.shots(file, PoseSection(), None, 2)[0]
    assert len(finer) > 1.6 * len(shots)
    assert len(video.shots(file, PoseSection(max_views=5), None, 1)[0]) == 5
    fields = filmed(file, IngestSection(max_side=96))
    assert fields["names"] == names and fields["images"].shape == (len(names), 64, 96, 3)
    video.save(shots, file, tmp_path, 64)
    with Image.open(tmp_path / file_of(len(shots) - 1)) as last:
        assert last.size == (64, 43)
    assert media_packages([file]) == ("av",)


def filmed(file, settings):
    """The fields of a video of which all frames are placed."""
    shots, _ = video.shots(file, PoseSection(), None, 1)
    model = model_of(
        [shot.name for shot in shots], [shot.size for shot in shots], [None] * len(shots)
    )
    model.frames = [shot.frame for shot in shots]
    return video.read(file, settings, model)


def test_each_frame_is_undone_of_its_own_lens(tmp_path, monkeypatch):
    rng, numbers = np.random.default_rng(0), [3, 8]
    pixels = gaussian_filter(rng.uniform(0, 255, (2, 120, 160, 3)), (0, 1, 1, 0)).astype(np.uint8)
    pictures = dict(zip(numbers, map(Image.fromarray, pixels), strict=True))
    monkeypatch.setattr(
        video, "_read_frames", lambda _, asked: ((k, pictures[k]) for k in sorted(asked))
    )
    model = model_of(["a", "b"], [(160, 120)] * 2, [None] * 2)
    model.frames = numbers
    model.cameras = [["SIMPLE_RADIAL", [f, 80.0, 60.0, -0.1], 160, 120] for f in (150.0, 180.0)]
    fields = video.read(tmp_path / "a.mp4", IngestSection(), model)
    lenses = [Camera(*camera[:1], tuple(camera[1]), *camera[2:]) for camera in model.cameras]
    views = assembly.geometries(lenses, 640, most_cut=1)
    for k, (lens, view) in enumerate(zip(lenses, views, strict=True)):
        assert (fields["Ks"][k] == view.K).all() and view.K[0, 0] == lens.params[0]
        at = assembly.positions(lens, view)
        assert (
            fields["images"][k] == assembly.resampled(pictures[numbers[k]], lens, view, at)
        ).all()
    taken = list(fields["altered"]({"b"}))
    assert [(name, lens.params) for name, lens, _ in taken] == [("b", lenses[1].params)]


@pytest.mark.parametrize(
    ("lens", "cut"), [((440.0, -0.05), True), ((440.0, 0.0), True), ((400.0, -0.2), False)]
)
def test_views_through_almost_the_same_lens_are_of_one_size(lens, cut):
    lenses = [
        Camera("SIMPLE_RADIAL", (focal, 400.0, 300.0, term), 800, 600)
        if term
        else Camera("SIMPLE_PINHOLE", (focal, 400.0, 300.0), 800, 600)
        for focal, term in ((400.0, -0.05), lens)
    ]
    own = [assembly.geometry(lens, 800) for lens in lenses]
    found = assembly.geometries(lenses, 800, most_cut=0.05)
    assert (own[0].width, own[0].height) != (own[1].width, own[1].height)
    assert ((found[0].width, found[0].height) == (found[1].width, found[1].height)) == cut
    for mine, view in zip(own, found, strict=True):
        assert (mine.K == view.K).all() and view.width <= mine.width and view.height <= mine.height
    at, whole = assembly.positions(lenses[1], found[1]), assembly.positions(lenses[1], own[1])
    assert np.allclose(at, whole[:, : found[1].height, : found[1].width])
    photo = Image.fromarray(np.tile(np.arange(800, dtype=np.uint8)[:, None], (600, 1, 3)))
    cut_view, view = (
        assembly.resampled(photo, lenses[1], of, at_of)
        for of, at_of in ((found[1], at), (own[1], whole))
    )
    assert (cut_view == view[: found[1].height, : found[1].width]).all()


@pytest.mark.parametrize(
    ("turn", "row", "column"), [(-90, 10, -10), (90, -10, 10), (180, -10, -10)]
)
def test_a_video_is_turned_as_its_phone_was_held(tmp_path, turn, row, column):
    file = film(tmp_path / "a.mov", n=60, turn=turn)
    images = filmed(file, IngestSection())["images"]
    assert images.shape[1:3] == ((128, 192) if turn == 180 else (192, 128))
    red = images[0].astype(int)[row, column]
    assert red[0] > 150 > 80 > red[2]


def test_a_video_that_hardly_moves_says_so(tmp_path):
    with pytest.raises(DataFailure, match=r"3 are needed: walk around"):
        video.shots(film(tmp_path / "a.mp4", n=5), PoseSection(), None, 1)


@pytest.mark.parametrize(
    "content", [b"", b"text", bytes(64), b"ffconcat version 1.0\nfile b.mp4\n", None]
)
def test_what_is_no_video_is_named_and_no_playlist_is_followed(tmp_path, content):
    whole = film(tmp_path / "b.mp4", n=5).read_bytes()
    (tmp_path / "a.mp4").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(InputError, match=r"a\.mp4 is not a readable video"):
        video.shots(tmp_path / "a.mp4", PoseSection(), None, 1)


def test_without_the_extra_a_video_is_one_line_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "a.mp4").write_bytes(b"\0")
    for read in (videos.describe, lambda path: media_packages([path])):
        with pytest.raises(
            InputError, match=r"a\.mp4 is a video, which needs the extra `video`: .*\[video\]"
        ) as raised:
            read(tmp_path / "a.mp4")
        assert raised.value.exit_code == 3 and "\n" not in str(raised.value)


def test_a_file_names_a_scene_and_is_its_raw_input(tmp_path, monkeypatch):
    file = tmp_path / "my walk.MP4"
    file.write_bytes(b"\0")
    monkeypatch.chdir(tmp_path)
    for given in (str(file), "my walk.MP4"):
        name, values = scenes.scene_values(given)
        assert (name, values["source"]) == ("my-walk", {"kind": "video", "path": str(file)})
    for path in (file, tmp_path):
        assert raw_files("pose", {"source": {"kind": "video", "path": str(path)}}) == (
            tmp_path,
            [file],
        )
    (tmp_path / "b.mp4").write_bytes(b"\0")
    with pytest.raises(InputError, match="2 videos"):
        video.files(tmp_path)
