"""Every stage does its job on a toy scene and fails with the documented exit code."""

import copy
import dataclasses
import importlib
import inspect
import json
import re

import numpy as np
import pytest
from PIL import Image
from shared import INPUTS, TOY, published, run_stage
from tiny_teachers import color_reference, color_teacher, knowing_rooms

from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.points import Points
from chebsplat.stages.registry import OF_KNOWLEDGE, STAGES

pytestmark = pytest.mark.xdist_group("toy")


def changed(**sections):
    config = copy.deepcopy(TOY)
    for section, values in sections.items():
        config.setdefault(section, {}).update(values)
    return config


def inputs_of(toy, stage):
    return {role: toy[of] for role, of in INPUTS.get(stage, {}).items()}


@pytest.mark.parametrize("stage", INPUTS)
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
    first, blank, *rest = inspect.getdoc(
        importlib.import_module(f"chebsplat.stages.{stage}").run
    ).splitlines()
    reads, writes = " ".join(rest).split("Writes ")
    kinds = {
        name: row.schema.removeprefix("chebsplat.").partition("/")[0]
        for name, row in STAGES.items()
    }
    assert first.endswith(".") and not blank
    assert set(re.findall("`(.+?)`", reads)) == {kinds[of] for of in STAGES[stage].roles.values()}
    assert writes.startswith(f"`{kinds[stage]}`.")


RECORDS = {
    "capture": (Capture, "ingest"),
    "points": (Points, "sfm"),
    "gaussians": (Gaussians, "train"),
}


def but_for(role, change):
    """The toy scene's input of that role but for the fields that `change` makes of its record."""

    def made(toy, tmp):
        kind, of = RECORDS[role]
        record = kind.read(toy[of])
        return {role: published(tmp / of, dataclasses.replace(record, **change(record)))}, TOY

    return made


def one_photo(toy, tmp):
    (tmp / "photos").mkdir()
    Image.new("RGB", (32, 24)).save(tmp / "photos/a.jpg")
    return {}, {"source": {"kind": "photos", "path": str(tmp / "photos")}}


def one_frame(toy, tmp):
    one_photo(toy, tmp)
    frames = [{"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}]
    (tmp / "photos/transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    return {}, {"source": {"kind": "transforms", "path": str(tmp / "photos")}}


def teacher_of_nothing(toy, tmp):
    model = color_teacher(tmp, weights=np.zeros((3, 3)))
    return {}, {
        "channels": {"model": str(model), "reference": str(color_reference(tmp / "reference"))}
    }


def photos_apart(toy, tmp):
    model = knowing_rooms(color_teacher(tmp))
    return {}, changed(teach={"model": str(model), "n_views": 2, "n_points": 100})


def without_depth(capture):
    return {"depth": np.full(capture.depth.shape, np.nan, np.float32)}


def without_gaussians(checkpoint):
    return {"parameters": {name: values[:0] for name, values in checkpoint.parameters.items()}}


only_test_views = but_for("capture", lambda capture: {"is_test": capture.is_test | True})
FAILURES = {  # the inputs of a stage that are others than the toy scene's, and its config
    "pose": one_photo,
    "ingest": one_frame,
    "sfm": but_for("capture", without_depth),
    "channels": teacher_of_nothing,
    "teacher": but_for("capture", lambda capture: {"labels": None}),
    "agree": only_test_views,
    "teach": photos_apart,
    "train": only_test_views,
    "lift": only_test_views,
    "refine": but_for("gaussians", without_gaussians),
    "export": but_for("gaussians", without_gaussians),
    "evaluate": but_for("capture", lambda capture: {"is_test": capture.is_test & False}),
    "report": but_for("gaussians", lambda checkpoint: {"trace": []}),
}


@pytest.mark.parametrize("stage", FAILURES)
def test_data_that_cannot_be_worked_with_is_exit_4(toy, stage, tmp_path):
    changes, config = FAILURES[stage](toy, tmp_path)
    assert run_stage(stage, tmp_path / "out", inputs_of(toy, stage) | changes, config) == 4
    assert not (tmp_path / "out").exists()


def test_a_scene_without_a_surface_is_known_by_views_alone_and_says_so(toy, tmp_path):
    points = Points.read(toy["sfm"])
    few = {
        name: getattr(points, name)[:9] for name in ("means", "colors", "normals", "covariances")
    }
    made = toy | {"sfm": published(tmp_path / "few", dataclasses.replace(points, **few))}
    for stage in (*OF_KNOWLEDGE, "refine"):
        made[stage] = tmp_path / stage
        assert run_stage(stage, made[stage], inputs_of(made, stage)) == 0
        facts = artifact.read_manifest(made[stage]).facts
        assert stage == "recall" or "9 points of a surface" in str(facts["left_out"]), stage
    assert facts["changed_by_knowledge"] == 0
    # a lesson of nothing teaches nothing
    assert artifact.read_manifest(made["recall"]).facts["of"] == []


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
    for what in ("semantic branch", "stage teacher", "stage lift", "stage refine"):
        assert what in text
