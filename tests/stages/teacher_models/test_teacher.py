"""Any ONNX teacher: windows, scales and flips, label sets, closed sets, and a clear error for what
cannot be used.
"""

import numpy as np
import pytest
from click.testing import CliRunner
from onnx import helper
from PIL import Image
from shared import published, run_stage
from tiny_teachers import COLORS, color_teacher, write_model, write_settings, write_table

from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.features import Features
from chebsplat.formats.teacher_model import read_label_set, read_teacher
from chebsplat.labels.decode import class_codes
from chebsplat.pipelines.cli import main
from chebsplat.stages import teacher
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.teacher_models import onnx_session
from chebsplat.stages.teacher_models.image_encoder import TeacherInference

SIZE = (48, 64)


def painted(rng, size=SIZE):
    """An image of coloured blocks of 16 pixels, and the index of each pixel's colour."""
    blocks = rng.integers(0, 3, (-(-size[0] // 16), -(-size[1] // 16)))
    labels = np.kron(blocks, np.ones((16, 16), np.int64))[: size[0], : size[1]]
    return (np.array(list(COLORS.values()))[labels] * 127.5 + 127.5).astype(np.uint8), labels


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture of 4 views whose classes are colours."""
    views = [painted(np.random.default_rng(k)) for k in range(4)]
    images, labels = (np.stack(part) for part in zip(*views, strict=True))
    return published_capture(tmp_path_factory.mktemp("capture") / "capture", images, labels)


def published_capture(path, images, labels=None, class_names=tuple(COLORS)):
    n = len(images)
    record = Capture(
        [f"view_{k:03d}" for k in range(n)], images, np.tile(np.eye(3), (n, 1, 1)), None,
        np.arange(n) % 4 == 0,
        labels=None if labels is None else labels.astype(np.int16),
        class_names=list(class_names) or None,
    )  # fmt: skip
    return published(path, record)


def encoded(tmp_path, capture, model, inputs=None, **settings):
    """(exit code, features or None) of the teacher stage."""
    config = {"teacher": {"model": str(model)} | settings}
    code = run_stage("teacher", tmp_path / "out", {"capture": capture} | (inputs or {}), config)
    return code, Features.read(tmp_path / "out") if code == 0 else None


def image_of(capture, view=0):
    return Capture.read(capture).images[view]


# what a teacher says


def test_every_pixel_of_a_view_is_told_by_its_colour(tmp_path, capture):
    code, found = encoded(tmp_path, capture, color_teacher(tmp_path))
    assert code == 0
    assert found.features.shape == (4, 12, 16, 3)
    assert found.label_names == list(COLORS)
    assert np.array_equal(found.pseudo_labels[:], Capture.read(capture).labels[:, ::4, ::4])
    assert np.allclose(np.linalg.norm(found.features[:].astype(np.float32), axis=-1), 1, atol=1e-3)
    known = {
        "teacher": "tiny",
        "output": "features",
        "normalized": True,
        "n_scales": 1,
        "flips": False,
    }
    assert known.items() <= found.convention.items()
    assert found.convention["sha256"] == artifact.sha256_file(tmp_path / "tiny.onnx")
    assert found.convention["stride"] == [4, 4]


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        ({"shape": (1, 3, 32, 32)}, {}),  # fixed in the graph: windows that overlap
        ({"size": [32, 32]}, {}),  # fixed in the TOML
        ({"size": [32, 128]}, {}),  # wider than the view: padded
        ({"stride": 2}, {}),  # finer than the map
        ({"stride": 16}, {"downscale": 8}),  # coarser than the map
        ({"multiple": 56}, {}),  # sides that no view has
        ({"base": 96}, {}),
        ({"base": 96, "size": [48, 48]}, {"scales": [0.75, 1.0, 1.25], "flips": True}),
        ({}, {"scales": [0.5, 1.0, 2.0]}),
        ({}, {"flips": True}),
    ],
)
def test_windows_scales_and_flips_leave_things_where_they_are(tmp_path, capture, model, settings):
    code, found = encoded(tmp_path, capture, color_teacher(tmp_path, **model), **settings)
    assert code == 0
    h, w = found.features.shape[1:3]
    rows, columns = (
        ((np.arange(n) + 0.5) * side / n).astype(int) for n, side in zip((h, w), SIZE, strict=True)
    )
    # blocks without their edges
    inner = np.outer(np.abs(rows % 16 - 7.5) < 5, np.abs(columns % 16 - 7.5) < 5)
    truth = Capture.read(capture).labels[:][:, rows][:, :, columns]
    assert (found.pseudo_labels[:] == truth)[:, inner].all()


def test_a_flip_is_undone_before_averaging(tmp_path, capture):
    """A model that sees left from right: its mean over flips is symmetric."""
    ramp = np.linspace(0, 1, 64, dtype=np.float32).reshape(1, 1, 1, 64)
    node = helper.make_node("Add", ["image", "ramp"], ["features"])
    write_model(tmp_path / "tiny.onnx", [node], shape=(1, 3, 48, 64), constants={"ramp": ramp})
    write_settings(tmp_path / "tiny.onnx")
    encoder, image = TeacherInference(read_teacher(tmp_path / "tiny.onnx"), 1), image_of(capture)
    straight = encoder.features(image, SIZE, (1.0,), True, "view")
    mirrored = encoder.features(image[:, ::-1], SIZE, (1.0,), True, "view")
    assert np.allclose(straight[:, ::-1], mirrored, atol=1e-6)
    assert not np.allclose(
        straight, encoder.features(image, SIZE, (1.0,), False, "view"), atol=1e-2
    )


def test_scales_keep_the_aspect_ratio_and_count_the_same(tmp_path, capture):
    encoder, image = TeacherInference(read_teacher(color_teacher(tmp_path)), 1), image_of(capture)
    assert [encoder.scaled_size(image, s) for s in (0.75, 1.0, 1.25)] == [
        (36, 48),
        (48, 64),
        (60, 80),
    ]
    both = encoder.features(image, (12, 16), (0.5, 1.0), False, "view")
    each = [encoder.features(image, (12, 16), (s,), False, "view") for s in (0.5, 1.0)]
    mean = each[0] + each[1]
    assert np.allclose(both, mean / np.linalg.norm(mean, axis=-1, keepdims=True), atol=1e-6)


def test_channels_are_reduced_in_every_view_and_the_labels_are_the_teacher_s(tmp_path, capture):
    rng = np.random.default_rng(0)
    wide = np.linalg.qr(rng.normal(size=(100, 3)))[0]  # 100 channels of rank 3
    color_teacher(tmp_path, weights=wide)
    write_table(tmp_path / "tiny.npz", embeddings=np.array(list(COLORS.values())) @ wide.T)
    matrix = np.linalg.qr(np.concatenate([wide, rng.normal(size=(100, 5))], 1))[0].astype(
        np.float32
    )
    record = ChannelMap(matrix, matrix.T.copy(), np.ones(100, np.float32), "tiny", {})
    channels = published(tmp_path / "channels", record)
    code, found = encoded(tmp_path, capture, tmp_path / "tiny.onnx", {"channels": channels})
    assert code == 0
    assert found.features.shape[3] == 8
    assert found.channels is not None
    plain = tmp_path / "plain"
    plain.mkdir()
    _, own = encoded(plain, capture, color_teacher(plain))
    assert np.array_equal(found.pseudo_labels[:], own.pseudo_labels[:])
    assert np.allclose(found.features[:] @ found.label_embeddings.T,
                       own.features[:] @ own.label_embeddings.T,
                       atol=4e-3)  # fmt: skip


# labels


def test_a_label_file_names_labels_and_their_synonyms(tmp_path, capture):
    file = tmp_path / "labels.txt"
    file.write_text("# warm and cold\n\nwarm: red  # fire\ncold: green, blue\n")
    assert read_label_set(file) == {"warm": ["warm", "red"], "cold": ["cold", "green", "blue"]}
    model = color_teacher(tmp_path)
    rows = [*COLORS.values(), (1, -0.9, -1), (-1, 1, 1)]
    write_table(tmp_path / "tiny.npz", [*COLORS, "warm", "cold"], np.array(rows))
    code, found = encoded(tmp_path, capture, model, labels=str(file))
    assert (code, found.label_names) == (0, ["warm", "cold"])
    units = np.array(rows) / np.linalg.norm(rows, axis=1, keepdims=True)
    mean = units[[4, 1, 2]].mean(0)
    assert np.allclose(found.label_embeddings[1], mean / np.linalg.norm(mean), atol=1e-6)


def test_a_capture_without_classes_is_asked_for_the_teacher_s_own_labels(tmp_path):
    image, _ = painted(np.random.default_rng(0))
    plain = published_capture(tmp_path / "plain", image[None], class_names=())
    write_table(color_teacher(tmp_path).with_suffix(".npz"), ["blue", "red"])
    code, found = encoded(tmp_path, plain, tmp_path / "tiny.onnx")
    assert (code, found.label_names) == (0, ["blue", "red"])


def segmenter(folder, names="red\ngreen\nblue\n"):
    (folder / "classes.txt").write_text(names)
    return color_teacher(folder, weights=5 * np.eye(3), output="logits", labels="classes.txt")


def test_a_closed_set_segmenter_gives_its_likeliest_classes_and_their_probabilities(
    tmp_path, capture
):
    code, found = encoded(tmp_path, capture, segmenter(tmp_path))
    assert code == 0
    assert np.array_equal(found.pseudo_labels[:], Capture.read(capture).labels[:, ::4, ::4])
    likely = 1 / (1 + 2 * np.exp(-10))
    assert np.allclose(found.confidence[:], likely, atol=1e-3)
    assert np.array_equal(found.label_embeddings, class_codes(list(COLORS), 13))
    assert np.allclose(found.features[:], found.label_embeddings[found.pseudo_labels[:]], atol=2e-3)


def test_classes_of_a_segmenter_that_mean_one_label_become_it(tmp_path, capture):
    file = tmp_path / "labels.txt"
    file.write_text("sea: blue_, GREEN\n")
    code, found = encoded(tmp_path, capture, segmenter(tmp_path), labels=str(file))
    assert (code, found.label_names) == (0, ["red", "sea"])
    file.write_text("sea: blu\n")
    assert encoded(tmp_path / "other", capture, tmp_path / "tiny.onnx", labels=str(file))[0] == 3


@pytest.mark.parametrize(
    ("classes", "labels", "names"),
    [
        ("red\ngreen\nsea", "", ["red", "green"]),  # a fifth of the pixels
        ("Sky\nroad\nsea", "", ["Sky", "road", "sea"]),  # all are of outdoors: this is no room
        ("red\ngreen\nsea", "sea: sea\n", ["red", "green", "sea"]),  # asked for
        ("red\nblue\nsea", "blue: blue, sea\n", ["red", "blue"]),
    ],
)
def test_classes_of_outdoors_are_left_out_of_a_room(tmp_path, classes, labels, names):
    image, _ = painted(np.random.default_rng(0))
    image[image[..., 2] > 128] = (255, 0, 0)
    image[:6] = (0, 0, 255)
    capture = published_capture(tmp_path / "room", image[None], class_names=())
    (tmp_path / "labels.txt").write_text(labels)
    asked = {"labels": str(tmp_path / "labels.txt")} if labels else {}
    code, found = encoded(tmp_path, capture, segmenter(tmp_path, f"{classes}\n"), **asked)
    assert (code, found.label_names) == (0, names)
    assert (found.pseudo_labels[:] >= 0).all()
    unsure = found.confidence[:] < 0.01  # of pixels of what is left out, which is not forgotten
    assert unsure.any() == ("sea" not in found.label_names and not labels)


def test_of_a_segmenter_whose_toml_says_no_output_the_labels_tell(tmp_path):
    """Names alone are of channels; a table of embeddings, or an encoder of words, is of
    features.
    """
    model = segmenter(tmp_path)
    for toml, output, guessed in (
        ('labels = "classes.txt"\noutput = "logits"\n', "logits", False),
        ('labels = "classes.txt"\n', "logits", True),
        ('labels = "tiny.npz"\n', "features", False),
        ('labels = "classes.txt"\ntext = "minilm"\n', "features", False),
    ):
        model.with_suffix(".toml").write_text(toml)
        assert (read_teacher(model).output, read_teacher(model).guessed) == (output, guessed)


# what check-teacher tells


def test_check_teacher_tells_what_a_teacher_is_and_sees(tmp_path):
    Image.new("RGB", (64, 48), (0, 0, 255)).save(tmp_path / "photo.png")
    model, photo = color_teacher(tmp_path, size=[32, 32]), ["--photo", str(tmp_path / "photo.png")]
    told = CliRunner().invoke(main, ["check-teacher", str(model), *photo])
    assert told.exit_code == 0
    for what in (
        "tiny (",
        "features, 3 channels",
        "64 x 48",
        "6 of 32 x 32",
        "16 x 12",
        "3, from",
        "blue 100%",
    ):
        assert what in told.stdout


def sidelong_teacher(folder):
    """A colour teacher that says of four pixels what the four to their right show."""
    path = color_teacher(folder)
    kernel = np.zeros((3, 3, 4, 8), np.float32)
    kernel[..., 4:] = np.eye(3)[:, :, None, None] / 16
    node = helper.make_node(
        "Conv", ["image", "kernel"], ["features"], strides=[4, 4], pads=[0, 0, 0, 4]
    )
    write_model(path, [node], constants={"kernel": kernel})
    return path


@pytest.mark.parametrize(("flips", "calls"), [(False, 6), (True, 8)])
@pytest.mark.parametrize("make", [color_teacher, sidelong_teacher])
def test_some_views_are_looked_at_mirrored_and_labels_are_held_against_the_truth(
    tmp_path, capture, monkeypatch, make, flips, calls
):
    seen, encode = [], TeacherInference.features
    monkeypatch.setattr(teacher, "MIRRORED", 2)
    monkeypatch.setattr(
        TeacherInference, "features", lambda *given: seen.append(given) or encode(*given)
    )
    assert encoded(tmp_path, capture, make(tmp_path), flips=flips)[0] == 0
    assert len(seen) == calls
    facts = artifact.read_manifest(tmp_path / "out").facts
    upright = make is color_teacher
    assert facts["mirrored_alike"] == 1 if upright else 0.2 < facts["mirrored_alike"] < 0.9
    assert (facts["right"] == 1) == upright


# a run that is killed


def test_views_that_a_stopped_run_finished_are_not_encoded_again(tmp_path, capture, monkeypatch):
    model, seen, encode = sidelong_teacher(tmp_path), [], TeacherInference.features
    monkeypatch.setattr(teacher, "MIRRORED", 2)

    def counted(self, image, grid, scales, flips, name):
        if name == "view_002" and "view_002" not in seen:
            seen.append(name)
            raise KeyboardInterrupt
        seen.append(name)
        return encode(self, image, grid, scales, flips, name)

    monkeypatch.setattr(TeacherInference, "features", counted)
    assert encoded(tmp_path, capture, model)[0] == 1
    assert not (tmp_path / "out").exists()
    assert encoded(tmp_path, capture, model)[0] == 0
    assert seen == [f"view_{k:03d}" for k in (0, 1, 2, 2, 3, 1, 3)]  # the last two are mirrored
    whole = run_stage(
        "teacher", tmp_path / "whole", {"capture": capture}, {"teacher": {"model": str(model)}}
    )
    assert whole == 0
    assert values_of(tmp_path / "whole") == values_of(tmp_path / "out")
    facts = [artifact.read_manifest(tmp_path / name).facts for name in ("whole", "out")]
    assert facts[0] == facts[1] and 0.2 < facts[0]["mirrored_alike"] < 0.9


def test_another_teacher_starts_anew(tmp_path, capture, monkeypatch):
    """What a stopped run left by other flips, scales, weights or labels is never taken for this
    one's; each differs from the one before in one of these.
    """
    before: set[int] = set()
    (tmp_path / "labels.txt").write_text("red\nblue\n")
    flips, scales = {"flips": True}, {"flips": True, "scales": [2.0]}
    labels = scales | {"labels": str(tmp_path / "labels.txt")}
    for sign, settings in ((1, {}), (1, flips), (1, scales), (-1, scales), (-1, labels)):
        model = color_teacher(tmp_path, weights=sign * np.eye(3))
        with monkeypatch.context() as stopped:
            stopped.setattr(
                "chebsplat.formats.features.FeatureWriter.finish", lambda *a, **k: 1 / 0
            )
            assert encoded(tmp_path, capture, model, **settings)[0] == 1
        marks = {
            mark: mark.stat().st_mtime_ns
            for mark in (tmp_path / ".part-out/features/done").iterdir()
        }
        assert len(marks) == 4
        assert not set(marks.values()) & before
        before = set(marks.values())


def values_of(path):
    """Digests of all files but the log, which tells when things were done."""
    return {
        name: entry["sha256"]
        for name, entry in artifact.verify(path).files.items()
        if name != "log.jsonl"
    }


def test_a_model_runs_on_the_gpu_where_onnxruntime_has_cuda_and_is_said_not_to_otherwise(
    tmp_path, capture, monkeypatch
):
    assert (
        onnx_session.providers("cpu") == onnx_session.providers("cuda") == ["CPUExecutionProvider"]
    )
    (tmp_path / "out").mkdir()
    config = configs.build({"teacher": {"model": str(color_teacher(tmp_path))}}, "colors")
    job = Job({"capture": capture}, config, tmp_path / "out", tmp_path / "scratch", "cuda")
    teacher.run(job)
    assert "onnxruntime-gpu" in job.facts["left_out"]["the teacher on the GPU"]
    both = [onnx_session.CUDA, "CPUExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: both)
    assert (onnx_session.providers("cpu"), onnx_session.providers("cuda")) == (both[1:], both)
