"""Every stage does its job on a toy scene and fails with the documented exit code."""

import copy
import importlib
import inspect
import re

import numpy as np
import pytest
from shared import INPUTS, TOY, published, run_stage

from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.points import Points
from chebsplat.stages.registry import STAGES

pytestmark = pytest.mark.xdist_group("toy")


def changed(**sections):
    config = copy.deepcopy(TOY)
    for section, values in sections.items():
        config.setdefault(section, {}).update(values)
    return config


def inputs_of(toy, stage):
    return {role: toy[of] for role, of in INPUTS[stage].items()}


@pytest.mark.parametrize("stage", STAGES)
def test_a_finished_artifact_is_whole_and_a_second_call_does_nothing(toy, stage, capsys):
    manifest = artifact.verify(toy[stage], STAGES[stage].schema)
    assert manifest.seconds > 0
    assert (toy[stage] / "log.jsonl").is_file()
    before = (toy[stage] / "artifact.json").stat().st_mtime_ns
    capsys.readouterr()
    assert run_stage(stage, toy[stage], inputs_of(toy, stage)) == 0
    assert (toy[stage] / "artifact.json").stat().st_mtime_ns == before
    assert capsys.readouterr().out == f"{toy[stage]}\n"


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_says_what_it_computes_reads_and_writes(stage):
    first, blank, *rest = inspect.getdoc(importlib.import_module(f"chebsplat.stages.{stage}").run).splitlines()
    reads, writes = " ".join(rest).split("Writes ")
    kinds = {name: row.schema.removeprefix("chebsplat.").partition("/")[0] for name, row in STAGES.items()}
    assert first.endswith(".") and not blank
    assert set(re.findall("`(.+?)`", reads)) == {kinds[of] for of in STAGES[stage].roles.values()}
    assert writes.startswith(f"`{kinds[stage]}`.")


def one_photo(toy, tmp):
    from PIL import Image

    (tmp / "photos").mkdir()
    Image.new("RGB", (32, 24)).save(tmp / "photos/a.jpg")
    return {}, {"source": {"kind": "photos", "path": str(tmp / "photos")}}


def without_depth(toy, tmp):
    record = Capture.read(toy["ingest"])
    record.depth = np.full(record.depth.shape, np.nan, np.float32)
    return {"capture": published(tmp / "c", record)}, TOY


def teacher_of_nothing(toy, tmp):
    from tiny_teachers import color_reference, color_teacher

    model = color_teacher(tmp, weights=np.zeros((3, 3)))
    return {}, {"channels": {"model": str(model), "reference": str(color_reference(tmp / "reference"))}}


def photos_apart(toy, tmp):
    from tiny_teachers import color_teacher, knowing_rooms

    model = knowing_rooms(color_teacher(tmp))
    return inputs_of(toy, "teach"), changed(knowledge={"model": str(model), "n_views": 2, "n_points": 100})


def without_labels(toy, tmp):
    record = Capture.read(toy["ingest"])
    record.labels = None
    path = published(tmp / "c", record)
    return {"capture": path}, TOY


def without_points(toy, tmp):
    record = Points.read(toy["sfm"])
    for name in ("means", "colors", "normals", "covariances"):
        setattr(record, name, getattr(record, name)[:0])
    return {"points": published(tmp / "p", record)}, TOY


def only_test_views(toy, tmp):
    record = Capture.read(toy["ingest"])
    record.is_test[:] = True
    path = published(tmp / "c", record)
    return inputs_of(toy, "train") | {"capture": path}, TOY


def only_test_views_to_lift(toy, tmp):
    inputs, config = only_test_views(toy, tmp)
    return inputs_of(toy, "lift") | {"capture": inputs["capture"]}, config


def only_test_views_to_agree(toy, tmp):
    inputs, config = only_test_views(toy, tmp)
    return inputs_of(toy, "agree") | {"capture": inputs["capture"]}, config


def without_gaussians(toy, tmp):
    record = Gaussians.read(toy["train"])
    record.parameters = {name: values[:0] for name, values in record.parameters.items()}
    return {"gaussians": published(tmp / "g", record)}, TOY


def nothing_to_refine(toy, tmp):
    inputs, config = without_gaussians(toy, tmp)
    return inputs_of(toy, "refine") | inputs, config


def strict_tolerance(toy, tmp):
    return inputs_of(toy, "onnx"), changed(onnx={"tolerance": 1e-12})


def encoder_without_attention(toy, tmp):
    inputs = {role: toy[of] for role, of in INPUTS["train"].items()}
    config = changed(train={"encoder": "mlp", "steps": 8})
    assert run_stage("train", tmp / "mlp", inputs, config) == 0
    return {"gaussians": tmp / "mlp"}, TOY


def no_test_view(toy, tmp):
    record = Capture.read(toy["ingest"])
    record.is_test[:] = False
    path = published(tmp / "c", record)
    return inputs_of(toy, "evaluate") | {"capture": path}, TOY


def without_trace(toy, tmp):
    record = Gaussians.read(toy["train"])
    record.trace = []
    path = published(tmp / "g", record)
    return inputs_of(toy, "report") | {"gaussians": path}, TOY


FAILURES = {
    "ingest": one_photo,
    "sfm": without_depth,
    "channels": teacher_of_nothing,
    "teacher": without_labels,
    "agree": only_test_views_to_agree,
    "teach": photos_apart,
    "describe": without_points,
    "train": only_test_views,
    "lift": only_test_views_to_lift,
    "refine": nothing_to_refine,
    "export": without_gaussians,
    "onnx": strict_tolerance,
    "cks": encoder_without_attention,
    "evaluate": no_test_view,
    "report": without_trace,
}


@pytest.mark.parametrize("stage", STAGES)
def test_data_that_cannot_be_worked_with_is_exit_4(toy, stage, tmp_path):
    inputs, config = FAILURES[stage](toy, tmp_path)
    assert run_stage(stage, tmp_path / "out", inputs, config) == 4
    assert not (tmp_path / "out").exists()


def test_rendering_only_scenes_leave_the_semantic_branch_out(toy, tmp_path):
    def made(stage, inputs):
        assert run_stage(stage, tmp_path / stage, inputs) == 0
        return tmp_path / stage

    gaussians = made("train", {"capture": toy["ingest"], "points": toy["sfm"]})
    exported = made("export", {"gaussians": gaussians})
    evaluation = made("evaluate", {"capture": toy["ingest"], "scene": exported})
    page = made("report", {"evaluation": evaluation, "gaussians": gaussians}) / "report.html"
    assert "features" not in Gaussians.read(gaussians).parameters
    assert "segmentation" not in Evaluation.read(evaluation).figures
    text = page.read_text()
    for what in ("semantic branch", "stage teacher", "stage describe", "stage onnx", "stage cks"):
        assert what in text


@pytest.mark.parametrize("spectrum", ["taper", "hard"])
def test_a_cut_spectrum_is_described_trained_on_and_recorded(toy, spectrum, tmp_path):
    config = changed(describe={"spectrum": spectrum, "n_eigs": 4})
    described, trained = tmp_path / "described", tmp_path / "trained"
    assert run_stage("describe", described, {"points": toy["sfm"]}, config) == 0
    facts = artifact.read_manifest(described, STAGES["describe"].schema).facts
    assert facts["spectrum"] == spectrum
    assert (facts.get("n_cuts", 0) > 0) == (spectrum == "hard")
    inputs = {"capture": toy["ingest"], "points": toy["sfm"], "features": toy["teacher"], "descriptors": described}
    assert run_stage("train", trained, inputs, config) == 0


def test_descriptors_of_another_setting_are_exit_3(toy, tmp_path, capsys):
    config = changed(describe={"bandwidth": 0.9})
    inputs = {role: toy[of] for role, of in INPUTS["train"].items()}
    assert run_stage("train", tmp_path / "out", inputs, config) == 3
    assert "describe.bandwidth" in capsys.readouterr().err
