"""Agreement of views: chance is 0, certainty is 1, and what hides a point is seen to."""

from dataclasses import replace

import numpy as np
import pytest
from malformed.artifacts import LABELS, N, artifacts
from shared import published, run_stage

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import ViewAgreement
from chebsplat.formats.features import Features
from chebsplat.formats.points import Points
from chebsplat.labels.agreement import between, far_pairs, project, unhidden

K, SIZE = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (64, 48)


def test_views_that_say_the_same_agree_by_one_whatever_they_say():
    said = np.random.default_rng(0).integers(0, 5, 900)
    assert between(said, said, 5).value == pytest.approx(1)
    assert between(np.array([0, 0, 3]), np.array([0, 0, 3]), 5).value == pytest.approx(1)


def test_views_that_draw_their_labels_agree_by_chance_alone():
    rng, shares = np.random.default_rng(0), [0.7, 0.2, 0.1]
    first, second = (rng.choice(3, 200_000, p=shares) for _ in range(2))
    found = between(first, second, 3)
    assert abs(found.value) < 0.01  # √(1 / 20,000 points of the rarest label) is 0.007
    np.testing.assert_allclose(found.share, shares, atol=0.005)


def test_a_teacher_that_has_one_word_for_everything_earns_nothing():
    wall = np.zeros(500, int)
    assert between(wall, wall, 4).value == 0
    other = wall.copy()
    other[:5] = 1  # once in a hundred, and never twice the same
    assert between(wall, other, 4).value < 0.05


def test_labels_count_alike_however_common_and_the_two_views_may_be_swapped():
    first, second = np.repeat([0, 1], [980, 20]), np.repeat([0, 1, 0], [980, 10, 10])
    found = between(first, second, 3)
    chance = 0.015 / 1.985  # of the rarer label, whose share is 0.015
    assert found.by_label[1] == pytest.approx((10 / 20 - chance) / (1 - chance))
    assert found.value == pytest.approx(np.mean(found.by_label[:2])) and np.isnan(found.by_label[2])
    assert between(second, first, 3).value == found.value


def test_nothing_seen_twice_is_no_agreement():
    none = np.zeros(0, int)
    assert np.isnan(between(none, none, 3).value)
    assert far_pairs(np.zeros((4, 3)), np.eye(3), np.eye(4, 3, dtype=bool)).shape == (0, 3)


def test_the_pair_of_a_point_is_the_most_different_two_that_see_it():
    eyes = np.array([[0, 0, -2.0], [0.1, 0, -2], [2, 0, 0], [0, 0, -9]])
    seen = np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 0, 1], [1, 0, 0, 0]], bool)
    assert far_pairs(np.zeros((4, 3)), eyes, seen).tolist() == [[0, 0, 2], [1, 0, 1], [2, 1, 3]]


def test_points_project_into_the_view_or_nowhere():
    points = np.array([[0, 0, 2.0], [0.4, -0.2, 2], [0, 0, -2], [9, 0, 2]])
    found = project(points, K, np.eye(4), SIZE)
    np.testing.assert_allclose(found[:2], [[32, 24, 2], [42, 19, 2]])
    assert np.isnan(found[2:]).all()


@pytest.mark.parametrize("with_depth", [True, False])
def test_a_point_behind_a_surface_is_hidden_and_one_on_it_is_not(with_depth):
    u, v = np.meshgrid(np.arange(2, 62, 3.0), np.arange(2, 46, 3.0))
    wall = np.stack([u.ravel(), v.ravel(), np.full(u.size, 2.0)], 1)
    behind = wall[::7] + np.array([0, 0, 1])
    image = np.concatenate([wall, behind, [[np.nan] * 3]])
    seen = unhidden(image, SIZE, np.full(SIZE[::-1], 2.0) if with_depth else None)
    assert seen[: len(wall)].all()
    assert not seen[len(wall) :].any()


def test_a_sloping_floor_without_depth_does_not_hide_itself():
    u, v = np.meshgrid(np.arange(0, 640, 6.0), np.arange(340, 480, 6.0))
    # seen from 1.5 m above
    floor = np.stack([u.ravel(), v.ravel(), 500 * 1.5 / (v.ravel() - 240)], 1)
    assert unhidden(floor, (640, 480)).mean() > 0.6


INPUTS = {"capture": "ingest", "points": "sfm", "features": "teacher"}


def test_the_stage_warns_of_a_teacher_that_says_one_thing_and_records_it(tmp_path, capsys):
    """The small features have label 0 everywhere."""
    inputs = {role: artifacts() / name for role, name in INPUTS.items()}
    assert run_stage("agree", tmp_path / "out", inputs, {}) == 0
    found, facts = ViewAgreement.read(tmp_path / "out"), read_manifest(tmp_path / "out").facts
    assert found.agreement == facts["agreement"] == 0
    assert 0 < found.n_points <= N and list(found.labels) == LABELS[:1]
    told = [
        line for line in capsys.readouterr().err.splitlines() if "does not know this scene" in line
    ]
    assert len(told) == 1 and facts["doubt"] in told[0] and "docs/teachers.md" in told[0]
    assert "check-teacher" in told[0]
    assert run_stage("agree", tmp_path / "calm", inputs, {"agree": {"low": 0.0}}) == 0
    assert "doubt" not in read_manifest(tmp_path / "calm").facts


@pytest.mark.parametrize(
    ("confidence", "output", "warned"),
    [(0.4, "logits", True), (0.9, "logits", False), (0.4, "features", False)],
)
def test_a_segmenter_that_is_unsure_of_what_views_agree_on_is_warned_of(
    tmp_path, capsys, confidence, output, warned
):
    """Stripes of two labels agree better than chance."""
    small = Features.read(artifacts() / "teacher")
    stripes = np.arange(small.features.shape[2], dtype=np.int16) % 2
    labels = np.broadcast_to(stripes, small.features.shape[:3]).copy()
    features = np.asarray(small.label_embeddings)[labels].astype(np.float16)
    sure = np.full(labels.shape, confidence, np.float16)
    made = replace(
        small, features=features, pseudo_labels=labels, confidence=sure,
        convention={**small.convention, "kind": "onnx", "output": output},
    )  # fmt: skip
    inputs = {role: artifacts() / name for role, name in INPUTS.items()}
    inputs["features"] = published(tmp_path / "features", made)
    assert run_stage("agree", tmp_path / "out", inputs, {}) == 0
    assert ("softmax taken twice" in capsys.readouterr().err) == warned


def test_points_that_no_two_views_see_leave_the_figure_open(tmp_path, capsys):
    small = Points.read(artifacts() / "sfm")
    far = published(tmp_path / "far", replace(small, means=small.means + 1000))
    inputs = {role: artifacts() / name for role, name in INPUTS.items()} | {"points": far}
    assert run_stage("agree", tmp_path / "out", inputs, {}) == 0
    assert ViewAgreement.read(tmp_path / "out").agreement is None
    assert "not known" in capsys.readouterr().err


def test_tracks_tell_who_sees_a_point_where_there_is_no_depth(tmp_path):
    blind = published(
        tmp_path / "capture", replace(Capture.read(artifacts() / "ingest"), depth=None)
    )
    tracks = np.array([[0, 1], [0, 2], [1, 1], [2, 0], [2, 2]], np.int32)  # view 0 is a test view
    tracked = published(
        tmp_path / "tracked", replace(Points.read(artifacts() / "sfm"), tracks=tracks)
    )
    inputs = {"capture": blind, "points": tracked, "features": artifacts() / "teacher"}
    assert run_stage("agree", tmp_path / "out", inputs, {}) == 0
    # of the three, one is in two training views
    assert ViewAgreement.read(tmp_path / "out").n_points == 1
