"""A calibrated query: probabilities are of the maths they claim, kept with the teacher, and used
wherever one asks.
"""

import json
import shutil
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner
from shared import ROOT
from tiny_teachers import color_teacher, knowing_rooms

import chebsplat
from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import calibration as files
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.ply import read_ply
from chebsplat.formats.teacher_model import EMBEDDED, read_label_table, read_teacher
from chebsplat.labels.calibration import (
    Calibration,
    evidence,
    fitted,
    frequent,
    presence,
    probability,
    strongest,
)  # fmt: skip
from chebsplat.pipelines.cli import main
from chebsplat.stages.tools import calibrate
from chebsplat.synthetic import layout
from tests.stages.tools.test_query import EMBEDDINGS, N, asked, write_toy

OF = Calibration(margin=14.0, cosine=9.0, bias=-4.0, strength=1.0, offset=2.0)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@pytest.fixture
def sample():
    rng = np.random.default_rng(3)
    return rng.normal(size=(4, 10, 5)), unit(rng.normal(size=(3, 5))), unit(rng.normal(size=(6, 5)))


def test_evidence_is_the_margin_behind_the_best_rival_and_the_cosine(sample):
    features, words, rivals = sample
    found = evidence(features, words, rivals)
    assert found.shape == (4, 10, 3, 2)
    cosines = unit(features) @ words.T
    assert np.allclose(found[..., 1], cosines, atol=1e-6)
    assert np.allclose(
        found[..., 0], cosines - (unit(features) @ rivals.T).max(-1)[..., None], atol=1e-6
    )
    assert evidence(features, rivals, rivals)[..., 0].max() < 1e-6  # no rival is ahead of all


def test_blocks_change_nothing(sample, monkeypatch):
    whole = evidence(*sample)
    monkeypatch.setattr("chebsplat.labels.calibration.BLOCK", 20)
    assert np.array_equal(evidence(*sample), whole)


def test_a_probability_is_the_logistic_of_the_evidence_and_zero_where_nothing_is(sample):
    features, words, rivals = sample
    found = probability(features, words[0], rivals, OF)
    margin, cosine = np.moveaxis(evidence(features, words[:1], rivals)[..., 0, :], -1, 0)
    assert found.dtype == np.float32
    assert np.allclose(found, 1 / (1 + np.exp(-14 * margin - 9 * cosine + 4)), atol=1e-6)
    assert not probability(np.zeros((2, 3, 5)), words[0], rivals, OF).any()


def test_presence_is_told_by_the_likeliest_and_grows_with_them():
    few, many = np.full(10_000, 0.01), np.full(10_000, 0.01)
    few[:2], many[:50] = 0.9, 0.9
    assert strongest(few) < strongest(many)
    assert presence(few, OF) < presence(many, OF)
    assert strongest(np.ones(3)) < np.inf
    with pytest.raises(ValueError, match="no places"):
        strongest(np.zeros(0))


def test_frequent_words_are_the_nearest_of_enough_features():
    rng = np.random.default_rng(0)
    words = np.eye(4)
    rows = np.repeat(words[:3], [50, 49, 1], axis=0) + rng.normal(0, 0.01, (100, 4))
    assert frequent([rows[:60], rows[60:]], words, 0.02).tolist() == [0, 1]


def test_logistic_regression_finds_what_drew_the_outcomes():
    rng = np.random.default_rng(1)
    inputs, wanted = rng.normal(size=(200_000, 2)), np.array([2.0, -1.0, 0.5])
    truth = rng.random(len(inputs)) < 1 / (1 + np.exp(-(inputs @ wanted[:2] + wanted[2])))
    assert np.allclose(fitted(inputs, truth), wanted, atol=0.05)  # five standard errors
    # separable
    assert np.isfinite(fitted(np.array([[-1.0], [1.0]]), np.array([False, True]))).all()
    with pytest.raises(ValueError, match="both outcomes"):
        fitted(inputs, np.ones(len(inputs), bool))


@pytest.mark.parametrize(
    ("words", "rivals"), [(np.ones(5), np.ones((2, 5))), (np.ones((1, 5)), np.ones((0, 5)))]
)
def test_what_does_not_fit_is_an_error(words, rivals):
    with pytest.raises(ValueError, match="fit"):
        evidence(np.ones((3, 5)), words, rivals)


def test_the_embedded_teacher_ships_with_its_calibration_on_rooms_of_its_own():
    held = files.read_calibration(EMBEDDED)
    assert held.teacher == read_teacher(EMBEDDED).name
    assert set(held.rivals) <= set(read_label_table(EMBEDDED.with_name("embedded.npz"))[0])
    assert held.made["first_seed"] == calibrate.SEEDS[0]
    ranges = [value for value in vars(layout).values() if isinstance(value, range)]
    assert ranges and not any(set(calibrate.SEEDS) & set(other) for other in ranges)
    listed = tomllib.loads((ROOT / "teachers/words.toml").read_text())["absent"]
    assert not set(listed["calibration"]) & set(listed["measured"])
    assert len(listed["measured"]) == 30


def test_a_copy_of_the_embedded_teacher_is_calibrated_as_it_is(tmp_path):
    copied = tmp_path / "elsewhere.onnx"
    shutil.copy(EMBEDDED, copied)
    assert files.calibration_of(copied) == files.calibration_of(EMBEDDED)
    copied.write_bytes(b"another")
    assert files.calibration_of(copied) is None


def toy_calibration(model, **changes):
    """Of the six-channel teacher of test_query: its words are one another's rivals."""
    rivals = ["chair", "sofa", "wall", "object"]
    files.write_calibration(
        files.beside(model),
        files.TeacherCalibration(**{"teacher": "toy", "sha256": sha256_file(model),
                                    "rivals": rivals,
                                    "calibration": OF._asdict(), "made": {}} | changes),
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A scene `words` of a calibrated teacher whose table knows one word that is not in the scene:
    table.
    """
    known = EMBEDDINGS | {"table": [0, 0.1, 0.3, 0, 1, 0.9]}
    model = tmp_path / "toy.onnx"
    model.write_bytes(b"not run by a query")
    model.with_suffix(".toml").write_text('labels = "toy.npz"\n')
    rows = np.array(list(known.values()), np.float32)
    np.savez(tmp_path / "toy.npz", names=np.array(list(known)), embeddings=unit(rows))
    write_toy(tmp_path / "work/words", model)
    toy_calibration(model)
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    return tmp_path / "work"


def test_a_word_is_answered_in_probabilities_by_python_as_by_the_command(folder):
    scene = chebsplat.load(folder / "words")
    answer, (first, heading, *_) = scene.ask("seat"), asked("words", "seat").stdout.splitlines()
    assert str(answer) == first == f"{2 * N} of {3 * N} Gaussians are likelier than not 'seat'"
    assert "mean probability" in heading
    np.testing.assert_array_equal(answer.selected, np.arange(3 * N) < 2 * N)
    assert np.array_equal(answer.selected, answer.scores > 0.5)
    np.testing.assert_array_equal(scene.query("seat"), answer.scores)
    assert answer.calibrated and answer.present and answer.cut == 0.5
    assert len(scene.select(answer.selected)) == answer.selected.sum() > 0
    assert not scene.ask("table").present
    assert "'table' is probably not here" in asked("words", "table").stdout
    against = scene.ask("seat", against=["wall"])  # the user's own phrases: LERF's relevancy
    assert not against.calibrated and against.present is None


def test_an_extract_takes_what_the_cut_selects_and_refuses_what_is_absent(folder, tmp_path):
    command = ["extract", str(folder / "words"), "--query"]
    done = CliRunner().invoke(main, [*command, "seat", "--out", str(tmp_path / "seats.ply")])
    assert done.exit_code == 0, done.output
    held, scene = read_ply(tmp_path / "seats.ply")[0]["means"], chebsplat.load(folder / "words")
    selected = scene.points()[0][scene.ask("seat").selected]
    assert {tuple(mean) for mean in held} == {tuple(mean) for mean in selected}
    assert len(held) == len(selected) == 2 * N
    done = CliRunner().invoke(main, [*command, "table", "--out", str(tmp_path / "table.ply")])
    assert (done.exit_code, "probably not here" in done.output) == (4, True)
    assert not (tmp_path / "table.ply").exists()
    done = CliRunner().invoke(
        main, [*command[:2], "--against", "wall", "--out", str(tmp_path / "x.ply")]
    )
    assert (done.exit_code, "add --query" in done.output) == (2, True)


def test_without_a_calibration_or_for_labels_alone_relevancy_is_as_before(folder):
    files.beside(folder.parent / "toy.onnx").unlink()
    answer = chebsplat.load(folder / "words").ask("seat")
    assert (answer.calibrated, answer.present) == (False, None)
    assert "uncalibrated" in str(answer)
    write_toy(folder / "labels")
    answer = chebsplat.load(folder / "labels").ask("sofa")
    assert (answer.calibrated, answer.present) == (False, True)
    np.testing.assert_array_equal(answer.selected, np.arange(3 * N) // N == 1)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.write_text("{}"), "schema"),
        (
            lambda path: path.write_text(path.read_text().replace("relevancy/1", "relevancy/9")),
            "is not of",
        ),
        (
            lambda path: path.write_text(path.read_text().replace('"margin"', '"margins"')),
            "margin, cosine",
        ),
        (
            lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | {"rivals": []})),
            "rivals",
        ),
        (
            lambda path: path.write_text(
                json.dumps(json.loads(path.read_text()) | {"sha256": "0"})
            ),
            "another model",
        ),
    ],
)
def test_a_damaged_calibration_is_named(folder, damage, said):
    path = files.beside(folder.parent / "toy.onnx")
    damage(path)
    with pytest.raises(InputError, match=said):
        files.read_calibration(folder.parent / "toy.onnx")
    done = asked("words", "seat")
    assert (done.exit_code, path.name in done.stderr) == (3, True)


def test_calibrating_finds_what_drew_the_labels_of_rooms():
    """Words: of class 0, of class 1, which no room has, and of nothing."""
    rng, rooms = np.random.default_rng(5), []
    for _ in range(30):
        scores = rng.normal(0, 0.2, (2000, 3, 2))
        inputs = np.append(scores[:, 0], np.ones((2000, 1)), 1)
        here = rng.random(2000) < 1 / (1 + np.exp(-inputs @ [14, 9, -3]))
        scores[:, 1:] -= 0.3
        rooms.append(calibrate.RoomEvidence(scores, np.where(here, 0, 7)))
    queries = calibrate.Queries(["a", "b", "c"], np.eye(3), np.array([0, 1, -1]))
    of = calibrate.fit(rooms, queries._replace(classes=np.array([0, -1, -1])))
    assert np.allclose(of[:3], [14, 9, -3], rtol=0.05)
    shares = calibrate.figures(rooms, [of] * 3, queries)
    chosen = np.stack([room.evidence[:, 0] @ of[:2] + of.bias > 0 for room in rooms])
    here = np.stack([room.labels == 0 for room in rooms])
    assert shares["precision"] == pytest.approx((chosen & here).sum() / chosen.sum(), abs=1e-4)
    assert shares["recall"] == pytest.approx((chosen & here).sum() / here.sum(), abs=1e-4)
    assert (shares["present_found"], shares["absent_refused"]) == (1, 1)


def test_a_teacher_is_calibrated_by_one_command_and_never_twice_by_accident(tmp_path, monkeypatch):
    monkeypatch.setattr(calibrate, "N_VIEWS", 2)
    monkeypatch.setattr(calibrate, "N_POINTS", 1500)
    model = knowing_rooms(color_teacher(tmp_path))
    done = CliRunner().invoke(main, ["calibrate", str(model), "--rooms", "3"])
    assert done.exit_code == 0, done.stderr
    held = files.read_calibration(model)
    assert held.made["rooms"] == 3 and all(np.isfinite(list(held.calibration.values())))
    again = CliRunner().invoke(main, ["calibrate", str(model)])
    assert (again.exit_code, "exists; remove it, or add --force" in again.stderr) == (2, True)
    assert files.read_calibration(model) == held
    shutil.copy(model, tmp_path / "other.onnx")
    with pytest.raises(ConfigError, match="3 to 100 rooms"):
        calibrate.calibrate(model, 2, None)


def test_a_segmenter_has_nothing_to_calibrate(tmp_path):
    with pytest.raises(ConfigError, match="logits"):
        calibrate.calibrate(color_teacher(tmp_path, output="logits"), 3, None)
