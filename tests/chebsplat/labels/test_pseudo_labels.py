"""Pseudo labels that a source brings: pixels vote as much as they are sure, and none is no
label.
"""

import numpy as np
import pytest
from shared import KEY, TOY, run_stage

from chebsplat.errors import ConfigError
from chebsplat.evaluation.protocols import labels, scannet_closed
from chebsplat.evaluation.protocols.task import EvaluatedView, Task
from chebsplat.formats.artifact import publish
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.manifest import Manifest
from chebsplat.labels.decode import voted

CODES = np.eye(3, dtype=np.float32)


def test_votes_on_paper():
    # cells of 2 x 2:  0 0 | 1 none | 2        confidences  .2 .2 | 1 1 | .5
    #                  1 0 | 2 1    | none                   .9 .1 | .5 .5 | 1
    # first: 0 has .5, 1 has .9; second: 1 has 1.5, 2 has .5; third has two pixels, one of them none
    found = np.array([[0, 0, 1, -1, 2], [1, 0, 2, 1, -1]], np.int16)
    sure = np.array([[0.2, 0.2, 1, 1, 0.5], [0.9, 0.1, 0.5, 0.5, 1]])
    features, winners, confidence = voted(found, sure, CODES, 2)
    assert winners.tolist() == [[1, 1, 2]]
    assert confidence[0] == pytest.approx([0.9 / 4, 1.5 / 4, 0.5 / 2])
    assert features[0] == pytest.approx(np.array([[0.5, 0.9, 0], [0, 1.5, 0.5], [0, 0, 0.5]])
                                        / np.array([[np.hypot(0.5, 0.9)], [np.hypot(1.5, 0.5)],
                                                    [0.5]]))  # fmt: skip


def test_a_cell_without_a_label_or_without_confidence_is_taught_nothing():
    for found, sure in ((-1, 1.0), (2, 0.0)):
        features, winners, confidence = voted(
            np.full((4, 4), found, np.int16), np.full((4, 4), sure), CODES, 4
        )
        assert (features.tolist(), winners.tolist(), confidence.tolist()) == (
            [[[0, 0, 0]]],
            [[-1]],
            [[0]],
        )


def test_where_a_teacher_has_no_label_it_is_wrong():
    classes = list(scannet_closed.CLASSES)
    truth, told = np.array([[0, 0, 1, 1]]), np.array([[0, -1, 1, 1]], np.int16)
    features, drawn = np.eye(21, dtype=np.float32)[truth], truth.astype(np.int16)
    view = EvaluatedView("a", features, drawn, teacher_labels=told, truth=truth)
    task = Task(classes, np.eye(21), classes, boundary=1)
    assert labels.measure([view], task)["teacher"]["iou"]["wall"] == 0.5
    closed = scannet_closed.measure([view], task)["teacher"]
    assert (closed["iou"]["wall"], closed["iou"]["floor"], closed["iou"]["void"]) == (0.5, 1, 0)


@pytest.mark.xdist_group("toy")
def test_a_scene_learns_from_its_source_s_pseudo_labels(toy, tmp_path, capsys):
    record = Capture.read(toy["ingest"])
    truth = np.asarray(record.labels[:])
    record.pseudo_labels, record.confidence = truth.copy(), np.ones(truth.shape, np.float16)
    record.pseudo_labels[:, :8] = -1
    with publish(tmp_path / "capture", Manifest("chebsplat.capture/2", KEY, "ingest")) as tmp:
        record.write(tmp)
    config = TOY | {"teacher": {"kind": "given", "downscale": 4}}
    assert (
        run_stage("teacher", tmp_path / "teacher", {"capture": tmp_path / "capture"}, config) == 0
    )
    features = Features.read(tmp_path / "teacher")
    told = np.asarray(features.pseudo_labels[:])
    assert features.label_names == record.class_names
    assert (told[:, :2] == -1).all()
    assert (told[:, 2:] == truth[:, 9::4, 1::4]).mean() > 0.95
    assert features.convention["kind"] == "given"
    assert run_stage("teacher", tmp_path / "none", {"capture": toy["ingest"]}, config) == 4
    assert "no pseudo labels" in capsys.readouterr().err


def test_pseudo_labels_that_the_source_does_not_bring_are_refused_before_anything_runs(
    tmp_path, monkeypatch
):
    from chebsplat.pipelines.planning.plan import Planner

    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    with pytest.raises(ConfigError, match="brings no pseudo labels"):
        Planner().plan("toy", "teacher.kind=given")
