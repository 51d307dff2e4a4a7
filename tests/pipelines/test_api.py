"""A finished scene opened from Python: what it renders, answers and selects is what the stages
say.
"""

import os
import pydoc
import subprocess
import sys

import numpy as np
import pytest
from scipy.special import expit
from shared import ROOT

import chebsplat
from chebsplat.errors import ChebsplatError, ConfigError, DataFailure
from chebsplat.formats.capture import Capture
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import Scene
from chebsplat.pipelines.planning.plan import overrides, suffix
from chebsplat.render import SceneRenderer
from chebsplat.stages.evaluate import camera


@pytest.fixture(scope="module")
def scene(toy):
    return chebsplat.load(toy["export"])


def test_what_is_opened_is_the_exported_scene(scene, toy):
    held = Scene.read(toy["export"])
    assert len(scene) == len(held.parameters["means"])
    assert scene.features.shape == (len(scene), held.label_embeddings.shape[1])
    assert [camera.name for camera in scene.cameras] == held.cameras.names
    assert str(len(scene)) in repr(scene).replace(",", "")


def test_a_render_is_the_one_that_was_evaluated(scene, toy):
    held, shown = Scene.read(toy["export"]), scene.render(scene.cameras[2])
    image, features = SceneRenderer(held.parameters).render(camera(held, 2), with_features=True)
    np.testing.assert_array_equal(shown.color, image)
    np.testing.assert_array_equal(shown.features, features)
    assert shown.labels.max() < len(scene.label_names)


def test_depth_is_that_of_the_room(scene, toy):
    capture = Capture.read(toy["ingest"])
    errors = []
    for name in scene.cameras[0].name, scene.cameras[3].name:
        view, truth = scene.camera(name), capture.depth[capture.names.index(name)]
        found = scene.render(view).depth
        both = np.isfinite(found) & (truth > 0)
        assert both.mean() > 0.95
        errors.append(np.abs(found - truth)[both] / truth[both])
    assert np.median(np.concatenate(errors)) < 0.05


def test_a_resized_camera_sees_the_same(scene):
    small = scene.cameras[0].resized(scene.cameras[0].width // 2, scene.cameras[0].height // 2)
    shown, whole = scene.render(small), scene.render(scene.cameras[0])
    assert shown.color.shape[:2] == (small.height, small.width)
    reduced = whole.color.astype(float).reshape(small.height, 2, small.width, 2, 3).mean((1, 3))
    assert np.abs(reduced - shown.color).mean() < 1  # grey level
    eye = scene.cameras[0].cam_from_world @ [*scene.cameras[0].position, 1]
    np.testing.assert_allclose(eye[:3], 0, atol=1e-6)


def test_a_part_is_a_scene_and_a_ply(scene, tmp_path):
    label = scene.label_names[int(np.bincount(scene.labels[scene.labels >= 0]).argmax())]
    opacities = expit(scene.parameters["logit_opacities"])
    labelled = scene.labels == scene.label_names.index(label)
    least = float(np.median(opacities[labelled]))
    part = scene.select(label=label, min_opacity=least)
    assert len(part) == (labelled & (opacities >= least)).sum() < labelled.sum() < len(scene)
    assert set(part.labels) == {scene.label_names.index(label)}
    path = part.export(tmp_path / "part.ply")
    parameters, _, labels = read_ply(path)
    np.testing.assert_array_equal(parameters["means"], part.points()[0])
    np.testing.assert_array_equal(labels, part.labels)
    shown = part.render(part.cameras[0])
    assert 0 < (shown.alpha < 0.5).mean() < 1
    np.testing.assert_array_equal(shown.labels == -1, shown.alpha < 0.5)
    half = scene.select(np.arange(len(scene)) % 2 == 0)
    assert len(half) == (len(scene) + 1) // 2
    with pytest.raises(ConfigError, match="exists"):
        part.export(path)


def test_what_cannot_be_is_said(scene):
    with pytest.raises(ConfigError, match="no view zzz"):
        scene.camera("zzz")
    with pytest.raises(ConfigError, match=r"did you mean|there are"):
        scene.select(label="zzz")
    with pytest.raises(ConfigError, match="a mask bool"):
        scene.select(np.ones(3, bool))
    for opacity in (1.5, -0.1, float("nan")):
        with pytest.raises(ConfigError, match="from 0 to 1 is needed"):
            scene.select(min_opacity=opacity)
    for box in (
        (0, 0, 0, 1, 1),
        (0, 0, 0, 1, 0, 1),
        (0, 0, 0, 1, float("nan"), 1),
        (0, 0, 0, 1, 1, float("inf")),
    ):
        with pytest.raises(ConfigError, match="six numbers"):
            scene.select(box=box)
    n = len(scene)
    for filters, left_out in [
        ({"mask": np.zeros(n, bool)}, f"mask leaves out {n}"),
        ({"box": (500, 500, 500, 501, 501, 501)}, f"box leaves out {n}"),
        ({"min_opacity": 1.0, "label": "wall"}, f"opacity leaves out {n}"),
    ]:
        with pytest.raises(
            DataFailure, match=f"no Gaussian of {n} is left .*{left_out}.*centres lie from"
        ):
            scene.select(**filters)
    with pytest.raises(ConfigError, match="open the scene"):
        scene.query("wall")
    with pytest.raises(AttributeError):
        chebsplat.nothing  # noqa: B018


def test_help_lists_the_public_names_with_a_line_each():
    told = pydoc.plain(pydoc.render_doc(chebsplat))
    first = told.partition("PACKAGE CONTENTS")[0]
    for name in chebsplat.__all__:
        assert any(line.split()[:1] == [name] and "." in line for line in first.splitlines())
        assert f"    {name}(" in told


USERS = """
import chebsplat

scene = chebsplat.train("photos/", train={"steps": 9}, cores=2)
reveal_type(scene)
reveal_type(scene.render(scene.cameras[0]).color.shape)
chebsplat.load("toy", 3)
"""


@pytest.mark.slow
def test_a_users_script_is_checked_against_the_types(tmp_path):
    (tmp_path / "script.py").write_text(USERS)
    options = ["--strict", "--follow-imports=silent", "--ignore-missing-imports"]
    command = [sys.executable, "-m", "mypy", *options, "script.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    lines = done.stdout.splitlines()
    assert "chebsplat.stages.tools.scene.OpenedScene" in lines[0], done.stdout
    assert "tuple" in lines[1] and 'Too many arguments for "load"' in lines[2]
    assert len(lines) == 4, done.stdout  # and their number


def test_settings_are_values_and_name_the_links_as_the_command_does():
    given = {"train": {"steps": 10, "prune": False, "lr_means": 1e-4}, "source": {"path": "a, b"}}
    assert overrides(given) == given
    assert suffix({"train": {"steps": 10}, "sfm": {"max_points": 9}}) == suffix(
        "train.steps=10,sfm.max_points=9"
    )
    with pytest.raises(ConfigError, match="is a section"):
        overrides({"steps": 3})


def test_one_stage_runs_alone(toy, tmp_path):
    out = chebsplat.run_stage("export", tmp_path / "again", {"gaussians": toy["train"]})
    assert len(chebsplat.load(out)) > 0
    with pytest.raises(ConfigError, match="did you mean export"):
        chebsplat.run_stage("exprt", tmp_path / "x")
    with pytest.raises(ConfigError, match="needs inputs"):
        chebsplat.run_stage("export", tmp_path / "x")


def test_a_scene_is_brought_up_to_date_and_opened(quick_plans, monkeypatch):
    asked = []
    execute = lambda plans, stage, cores, device: asked.append(plans[0].title) or 4  # noqa: E731
    monkeypatch.setattr("chebsplat.pipelines.api.execute", execute)
    with pytest.raises(ChebsplatError, match="could not be finished"):
        chebsplat.train("toy", train={"steps": 7})
    assert asked == ["toy@train.steps=7"]
