"""`chebsplat query` finds what words mean in a finished scene, or says why it cannot."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from malformed.edits import put, remove
from PIL import Image
from shared import published

from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.features import Features
from chebsplat.formats.scene import Scene
from chebsplat.labels.calibration import relevancy
from chebsplat.pipelines.api import load
from chebsplat.pipelines.cli import main

EMBEDDINGS = {
    "chair": [1, 0, 0, 0, 0, 0], "sofa": [0.8, 0.6, 0, 0, 0, 0], "wall": [0, 0, 1, 0, 0, 0],
    "seat": [0.9, 0.4, 0, 0, 0.17, 0], "object": [0.3, 0, 0.3, 0.9, 0, 0],
    "things": [0, 0.3, 0.2, 0.9, 0, 0.2],
    "stuff": [0, 0, 0.3, 0.95, 0, 0], "texture": [0, 0, 0.5, 0.87, 0, 0],
}  # fmt: skip
LABELS = ["chair", "sofa", "wall"]
CANONICAL = ["object", "things", "stuff", "texture"]
N = 12  # Gaussians of a label
SIZE = (32, 48)


def vectors(names):
    rows = np.array([EMBEDDINGS[name] for name in names], np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def write_toy(folder, teacher=None):
    """A chair left, a sofa in the middle, a wall right; four of the teacher's six channels, or
    codes of labels.
    """
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal([x, 0, 4], 0.15, (N, 3)) for x in (-1.2, 0, 1.2)]).astype(
        np.float32
    )
    labels = np.repeat(np.arange(3), N).astype(np.int32)
    matrix = np.eye(6, 4, dtype=np.float32)
    channels = ChannelMap(matrix, matrix.T.copy(), np.ones(6, np.float32), "toy", {})
    known = vectors(LABELS) if teacher is None else channels.embed(vectors(LABELS))
    n = len(means)
    parameters = {
        "means": means, "log_scales": np.full((n, 3), -1.6, np.float32),
        "quats": np.eye(4, dtype=np.float32)[[0] * n],
        "logit_opacities": np.full(n, 4, np.float32),
        "sh0": rng.normal(0, 0.3, (n, 1, 3)).astype(np.float32),
        "shN": np.zeros((n, 15, 3), np.float32), "degrees": np.zeros(n, np.uint8),
        "features": known[labels],
    }  # fmt: skip
    K = np.array([[40, 0, SIZE[1] / 2], [0, 40, SIZE[0] / 2], [0, 0, 1]], float)
    views, Ks, poses = ["a.png", "b.png"], np.stack([K, K]), np.stack([np.eye(4)] * 2)
    scene = Scene(
        parameters, Cameras(views, Ks, poses, SIZE[1], SIZE[0]), np.arange(n), labels, LABELS, known
    )
    published(folder / "export", scene)
    capture = Capture(views, np.zeros((2, *SIZE, 3), np.uint8), Ks, poses, np.array([False, True]))
    published(folder / "ingest", capture)
    convention, model = {"kind": "labels"}, None
    if teacher is not None:
        convention, model = (
            {"kind": "onnx", "output": "features", "sha256": sha256_file(teacher)},
            str(teacher),
        )
    features = Features(
        views, np.zeros((2, 2, 2, known.shape[1]), np.float16), LABELS, known,
        convention=convention,
        channels=None if teacher is None else channels,
    )  # fmt: skip
    published(folder / "teacher", features, config={"teacher": {"model": model}})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folders `words` and `labels` of scenes, beside the teacher's files."""
    root = tmp_path_factory.mktemp("query")
    model = root / "toy.onnx"
    model.write_bytes(b"not run by a query")
    model.with_suffix(".toml").write_text('labels = "toy.npz"\n')
    np.savez(root / "toy.npz", names=np.array(list(EMBEDDINGS)), embeddings=vectors(EMBEDDINGS))
    write_toy(root / "words", model)
    write_toy(root / "labels")
    return root


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    """A copy that a test may damage; names are looked up in it."""
    shutil.copytree(made, tmp_path / "work")
    (tmp_path / "work/store/export").mkdir(parents=True)  # no scene, though it looks like one
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    teacher = tmp_path / "work/words/teacher"
    manifest = (teacher / "artifact.json").read_text()
    (teacher / "artifact.json").write_text(manifest.replace(str(made), str(tmp_path / "work")))
    return tmp_path / "work"


def asked(*arguments):
    return CliRunner().invoke(main, ["query", *map(str, arguments)])


def test_a_word_is_found_in_the_scene_and_drawn_by_render(folder, tmp_path):
    answer = load(folder / "words").ask("seat")
    assert (answer.scores.dtype, answer.scores.shape) == (np.float32, (3 * N,))
    assert not answer.calibrated and answer.presence is None
    assert answer.scores[: 2 * N].min() > 0.9
    assert answer.scores[2 * N :].max() < 0.1
    command = [
        "render",
        "words",
        "--path",
        "capture",
        "--what",
        "relevancy",
        "--query",
        "seat",
        "--out",
        str(tmp_path / "seats"),
    ]
    assert CliRunner().invoke(main, command).exit_code == 0
    heat = np.asarray(Image.open(tmp_path / "seats/relevancy/b.png.png")).astype(int)
    colored = np.ptp(heat, axis=-1) > 40
    middle = SIZE[0] // 2
    assert heat.shape == (*SIZE, 3)
    assert colored[middle, 12] and colored[middle, 24]
    assert not colored[:, 34:].any()


def test_the_answer_tells_the_labels_that_fit_best_and_writes_nothing(folder):
    before = sorted(folder.rglob("*"))
    done = asked("words", "seat", "--top", 2)
    lines = done.stdout.splitlines()
    assert (done.exit_code, len(lines)) == (0, 4)
    assert f"{2 * N} of {3 * N} Gaussians" in lines[0]
    assert [line.split()[0] for line in lines[-2:]] == ["sofa", "chair"]
    assert sorted(folder.rglob("*")) == before


def test_a_channel_map_that_holds_the_features_leaves_relevancy_as_it_is(folder):
    own = relevancy(vectors(LABELS).repeat(N, 0), vectors(["seat"])[0], vectors(CANONICAL))
    assert np.allclose(load(folder / "words").ask("seat").scores, own, atol=2e-3)


def test_what_it_is_weighed_against_can_be_chosen(folder):
    scores = load(folder / "words").ask("seat", ["sofa", "wall"]).scores
    assert scores[N : 2 * N].max() < 0.5 < scores[:N].min()
    chosen = asked(folder / "words", "seat", "--against", "sofa, wall").stdout.splitlines()
    assert chosen[0].startswith(f"{N} of {3 * N} Gaussians")


def test_a_scene_of_labels_is_asked_for_a_label_against_the_others(folder):
    assert asked("labels", "Sofa").exit_code == 0
    scores = load(folder / "labels").ask("Sofa").scores
    assert np.all((scores > 0.5) == (np.arange(3 * N) // N == 1))


def small_table(folder):
    np.savez(folder / "toy.npz", names=np.array(LABELS), embeddings=vectors(LABELS))


def leave_colours_alone(folder):
    scene = Scene.read(folder / "words/export")
    del scene.parameters["features"]
    shutil.rmtree(folder / "words/export")
    none = {"labels": None, "label_names": None, "label_embeddings": None}
    published(folder / "words/export", replace(scene, **none))


@pytest.mark.parametrize(
    ("damage", "arguments", "code", "said"),
    [
        (None, ["labels", "something to sit on"], 2, "no label of this scene"),
        (None, ["labels", "something to sit on"], 2, "teacher.kind=auto"),
        (None, ["words", "seatz"], 3, "near: seat"),
        (None, ["word", "seat"], 2, "there is words"),
        (None, ["store", "seat"], 2, "no finished scene"),
        (None, ["words", " "], 2, "empty"),
        (remove("words/teacher"), ["words", "seat"], 2, "no teacher's artifact"),
        (
            leave_colours_alone,
            ["words", "seat"],
            2,
            "make scene=words set=teacher.model=MODEL.onnx",
        ),
        (put("toy.onnx", "another"), ["words", "seat"], 3, "toy.onnx is not the model"),
        (small_table, ["words", "sofa"], 3, "choose with --against"),
    ],
)
def test_what_cannot_be_answered_is_told_with_the_remedy(folder, damage, arguments, code, said):
    if damage is not None:
        damage(folder)
    done = asked(*arguments)
    assert done.exit_code == code
    assert said in done.stderr
    assert not done.stdout
