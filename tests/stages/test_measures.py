"""Every stage has an error beside its seconds, of one table, and the course of a scene is that of
its stages.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logit
from shared import KEY

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.scene import Scene
from chebsplat.stages import evaluate, report, sfm
from chebsplat.stages.pages.measures import MEASURES, Row, course_of, figures_of, row_of, stops
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.training.truth import labels_right, pixels_right


def test_every_stage_of_a_scene_has_an_error_in_the_table_and_the_report_is_given_it():
    assert MEASURES.keys() == {stage.name for stage in STAGES.values() if stage.of_scene} - {
        "report"
    }
    assert MEASURES.keys() == set(report.STAGE_OF.values())
    assert {of.role for some in MEASURES.values() for of in some} <= report.STAGE_OF.keys()


@pytest.mark.xdist_group("toy")
def test_every_stage_of_a_scene_measures_its_error(toy):
    made = {
        role: read_manifest(toy[stage]) for role, stage in report.STAGE_OF.items() if stage in toy
    }
    assert made.keys() == report.STAGE_OF.keys() - {"model"}  # generated views bring their poses
    facts = {role: manifest.facts for role, manifest in made.items()}
    measured = {stage: figures_of(stage, facts) for stage in MEASURES if stage != "pose"}
    assert not [stage for stage, figures in measured.items() if not figures]
    assert facts["evaluation"]["layout_error"] == 0
    assert facts["capture"]["variance_kept"] == 1
    assert 0 < facts["points"]["depth_error"] < 0.03
    # three of ten segments bear another label
    assert facts["features"]["right"] == pytest.approx(0.7, abs=0.03)
    for role in ("gaussians", "lifted", "refined"):
        assert 0.4 < facts[role]["right"] <= 1


MACHINE = {
    "processor": "A",
    "gpu": "",
    "cores": 8,
    "threads": 2,
    "load": [0.5, 2.0],
    "seconds": 100.0,
}


def test_a_row_tells_the_error_first_which_way_is_better_and_every_machine():
    facts = {"refined": {"labels_agree": 0.9, "gain": None, "right": 0.5}}
    processes = [
        MACHINE | {"megabytes": 1240},
        MACHINE | {"processor": "B", "cores": 4, "load": [0.1, 1.0], "megabytes": 310},
    ]
    row = row_of("refine", Manifest("s/1", KEY, "refine", seconds=7.5, processes=processes), facts)
    assert row.figures == [
        "90.00% ↑ labels of half the training views that the other half reproduces",
        "50.00% ↑ pixels of training views with the true label",
    ]
    assert row[:3] == ("refine", 7.5, KEY)
    assert row.machine == "A, 2 threads and B, 2 threads of 8 and 4 cores, in 2 processes"
    assert (row.load, row.memory) == ("0.1 to 2.0", "1.2 GB")
    bare = row_of("onnx", Manifest("s/1", KEY, "onnx"), {})
    assert bare[3:] == ([], "a machine that was not recorded", "", "")


def test_a_scene_s_course_is_its_stages_one_after_the_other_and_its_stops_are_read_off_it():
    rows = [
        Row(*of, KEY, [], "", "", "")
        for of in (("ingest", 10.0), ("teacher", 5.0), ("train", 40.0), ("lift", 5.0))
    ]
    # of 40: the rest is no step
    trace = [{"seconds": 10.0, "psnr": 20.0}, {"seconds": 20.0, "psnr": 30.0}]
    facts = {"features": {"right": 0.5}, "gaussians": {"right": None}, "lifted": {"right": 0.75}}
    course = course_of(rows, facts, trace, 12.0)
    assert course.spans == [
        ("ingest", 0, 10),
        ("teacher", 10, 15),
        ("train", 15, 55),
        ("lift", 55, 60),
    ]
    assert (course.plain, course.colors) == (12, [(35, 20), (55, 30), (60, 30)])
    assert course.meanings == [("teacher", 15, 0.5), ("lift", 60, 0.75)]
    assert stops(course) == [
        ("before training", 15, 12, 0.5),
        # a quarter of it was not measured, and is not made up
        ("half of the training", 35, 20, 0.5),
        ("train", 55, 30, 0.5),
        ("lift", 60, 30, 0.75),
    ]
    early = course_of(rows, facts, [{"seconds": 2.0, "psnr": 14.0}, *trace], 12.0)
    assert stops(early)[1] == ("a quarter of the training", 25, 16.25, 0.5)
    # no true labels: halves of the views
    without = course_of(rows, {"lifted": {"labels_agree": 0.9}}, trace, 12.0)
    assert without.meanings == [("lift", 60, 0.9)] and "half the training views" in without.words
    assert course_of(rows, {}, trace, 12.0).meanings == []


@pytest.fixture
def wall():
    """Three views of a wall at a depth of 2, whose left half is `a` and whose right half is `b`;
    the last is a test.
    """
    K = np.array([[20.0, 0, 10], [0, 20.0, 8], [0, 0, 1]])
    labels = np.tile(np.where(np.arange(20) < 10, 0, 1).astype(np.int16), (3, 16, 1))
    return Capture(
        ["0", "1", "2"], np.zeros((3, 16, 20, 3), np.uint8), np.tile(K, (3, 1, 1)),
        np.tile(np.eye(4), (3, 1, 1)),
        np.array([False, False, True]), np.full((3, 16, 20), 2, np.float32), labels,
        class_names=["a", "b"],
    )  # fmt: skip


def gaussians_of(wall, shift=0.0):
    """A Gaussian at every second pixel of the wall, and one half transparent in front of each, of
    the other label.
    """
    x, y = ((np.arange(n)[1::2] + 0.5 - c) / 20 * 2 for n, c in ((20, 10), (16, 8)))
    places = np.stack(np.meshgrid(x + shift, y), -1).reshape(-1, 2)
    solid, veil = (np.column_stack([places, np.full(len(places), z)]) for z in (2.0, 1.99))
    opacities = np.repeat(logit([0.9, 0.3]), len(places))
    left = np.eye(2, dtype=np.float32)[(places[:, 0] > 0).astype(int)]
    return {"means": np.concatenate([solid, veil]), "logit_opacities": opacities}, np.concatenate(
        [left, left[:, ::-1]]
    )


def test_labels_of_gaussians_are_held_against_the_surface_of_training_views(wall):
    teacher = Features(
        ["0"], np.zeros((1, 2, 2, 2), np.float16), ["a", "b"], np.eye(2, dtype=np.float32)
    )
    parameters, features = gaussians_of(wall)
    assert labels_right(wall, parameters, features, teacher) > 0.9  # Gaussians lie 2 pixels apart
    assert labels_right(wall, parameters, features[:, ::-1], teacher) < 0.1
    wall.labels[2] = 1 - wall.labels[2]  # a test view is not looked at
    assert labels_right(wall, parameters, features, teacher) > 0.9
    wall.class_names[1] = "c"  # which the teacher has no word for
    assert labels_right(wall, parameters, np.tile([1, 0], (len(features), 1)), teacher) == 1
    wall.depth = None
    assert labels_right(wall, parameters, features, teacher) is None


def test_labels_of_pixels_are_held_against_those_of_training_views(wall):
    said = np.zeros((3, 4, 4), np.int16)
    teacher = Features(
        wall.names,
        np.zeros((3, 4, 4, 2), np.float16),
        ["a", "b"],
        np.eye(2, dtype=np.float32),
        said,
    )
    said[2] = -1  # of the test view
    assert pixels_right(wall, teacher) == 0.5
    said[1] = -1
    assert pixels_right(wall, replace(teacher, label_names=["b", "a"])) == 0.25
    assert pixels_right(wall, replace(teacher, label_names=["x", "y"])) is None


def test_points_are_held_against_the_depth_of_training_views_and_without_it_cells_are_counted(wall):
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 20), np.linspace(-0.6, 0.6, 20))
    means = np.stack([x, y, np.full_like(x, 2.02)], -1).reshape(-1, 3)
    means[::5, 2] = 3.0  # which lie behind the wall
    cloud = {
        "names": wall.names,
        "Ks": wall.Ks,
        "cam_from_world": wall.cam_from_world,
        "means": means,
    }
    assert sfm.check_points(wall, cloud) == {"depth_error": pytest.approx(0.01)}
    wall.depth = None
    assert sfm.check_points(wall, cloud)["covered"] > 0.5
    assert sfm.check_points(wall, cloud | {"means": means[:1]})["covered"] == pytest.approx(1 / 320)


@pytest.mark.xdist_group("toy")
def test_a_layout_that_shows_another_picture_is_told(toy, tmp_path):
    job = Job({"scene": toy["export"]}, Config(), tmp_path, tmp_path)
    scene = Scene.read(toy["export"])
    view = evaluate.camera(scene, 0)
    image = evaluate.SceneRenderer(scene.parameters).render(view)[0]
    assert evaluate.layout_error(job, scene, view, image) == 0
    image[0, 0, 0] ^= 64
    assert evaluate.layout_error(job, scene, view, image) == 64
