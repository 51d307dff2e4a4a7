"""Lifted features of small artifacts: of a checkpoint, in an export, and of a PLY that came from
elsewhere.
"""

import numpy as np
import pytest
from malformed.artifacts import VIEWS, N, artifacts
from shared import published, run_stage

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.lifted import Lifted
from chebsplat.formats.ply import write_ply
from chebsplat.formats.points import Points
from chebsplat.formats.scene import Scene
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.config import build
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.tools.lift_ply import lift_ply
from chebsplat.stages.training.assembly import model_of, start_features
from chebsplat.stages.training.views import training_views

ROLES = {"capture": "ingest", "gaussians": "train", "features": "teacher"}


@pytest.fixture
def lifted(tmp_path):
    assert (
        run_stage(
            "lift",
            tmp_path / "lift",
            {role: artifacts() / name for role, name in ROLES.items()},
            {},
        )
        == 0
    )
    return tmp_path / "lift"


def test_only_training_views_are_lifted_and_the_export_has_what_was(lifted, tmp_path):
    held = Lifted.read(lifted)
    assert held.notes["views"] == VIEWS[1:]  # the first is a test view
    assert held.n_views.max() <= 2
    assert held.features.shape == (N, 5)
    np.testing.assert_array_equal(held.half_views.sum(0), held.n_views)
    inputs = {
        "gaussians": artifacts() / "train",
        "features": artifacts() / "teacher",
        "lifted": lifted,
    }
    assert run_stage("export", tmp_path / "export", inputs, {}) == 0
    scene, unseen = Scene.read(tmp_path / "export"), ~held.features.any(1)
    assert unseen.any() and not unseen.all()
    np.testing.assert_array_equal(scene.labels[np.argsort(scene.order)] == -1, unseen)
    wanted = held.features[scene.order]
    step = np.abs(wanted).max(1, keepdims=True) / 127
    assert (np.abs(scene.parameters["features"] - wanted) <= 0.51 * step).all()


def test_a_ply_gets_what_its_checkpoint_gets_and_becomes_a_folder_of_artifacts(lifted, tmp_path):
    parameters = Gaussians.read(artifacts() / "train").parameters
    write_ply(tmp_path / "a.ply", parameters, 0)
    out = tmp_path / "out"
    figures = lift_ply(
        tmp_path / "a.ply", artifacts() / "ingest", None, artifacts() / "teacher", None, out
    )
    assert figures["gaussians"] == N
    features = Lifted.read(lifted).features
    np.testing.assert_array_equal(Lifted.read(out / "lift").features, features)
    scene = Scene.read(out / "export")
    np.testing.assert_array_equal(scene.labels[np.argsort(scene.order)] == -1, ~features.any(1))
    folders = {path.name for path in out.iterdir() if path.is_dir()}
    assert folders == {"gaussians", "lift", "export", "ingest", "teacher"}


def test_a_splat_in_another_frame_and_a_capture_without_poses_are_refused(tmp_path):
    parameters = Gaussians.read(artifacts() / "train").parameters
    write_ply(
        tmp_path / "far.ply", parameters | {"means": parameters["means"] + np.float32(1000)}, 0
    )
    with pytest.raises(DataFailure, match="same frame"):
        lift_ply(
            tmp_path / "far.ply",
            artifacts() / "ingest",
            None,
            artifacts() / "teacher",
            None,
            tmp_path / "far",
        )
    record = Capture.read(artifacts() / "ingest")
    record.cam_from_world = None
    posed, features = published(tmp_path / "capture", record), artifacts() / "teacher"
    with pytest.raises(InputError, match="has no poses"):
        lift_ply(tmp_path / "far.ply", posed, None, features, None, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_features_of_another_number_of_gaussians_are_refused(lifted, tmp_path, capsys):
    fewer = Gaussians.read(artifacts() / "train")
    fewer.parameters = {name: values[:-1] for name, values in fewer.parameters.items()}
    inputs = {"features": artifacts() / "teacher", "lifted": lifted}
    inputs["gaussians"] = published(tmp_path / "train", fewer)
    assert run_stage("export", tmp_path / "export", inputs, {}) == 3
    assert "make it again" in capsys.readouterr().err


def test_the_command_is_a_stage_without_a_file_and_a_use_with_one():
    import click
    from click.testing import CliRunner

    from chebsplat.pipelines.cli import main

    runner = CliRunner()
    assert "--in-gaussians" in runner.invoke(main, ["lift", "--help"]).output
    context = click.Context(main)
    assert {p.name for p in main.resolve_command(context, ["lift", "a.ply"])[1].params} >= {
        "ply",
        "capture",
        "out",
    }
    listed = main.list_commands(context)
    assert listed.count("lift") == 1


def test_features_of_a_training_start_as_what_the_views_say_of_its_gaussians(up_to_teacher):
    capture, points = Capture.read(up_to_teacher / "ingest"), Points.read(up_to_teacher / "sfm")
    features = Features.read(up_to_teacher / "teacher")
    config = build({"train": {"opacity": 0.7}}, "toy")
    model = model_of(points, features, config.train, config.describe)
    views = training_views(capture, points, features)
    start_features(model, capture, points, features, Progress(False))
    begun = model.raw["features"]
    assert begun.requires_grad and begun.detach().any(1).float().mean() > 0.9
    shares = []
    for k in range(len(views.names)):
        taught = views.features(k)
        rendered = model.render(views.camera(k, 1), 0, masked=False, grid=taught.shape[:2]).features
        maps = rendered.detach().numpy(), taught.numpy()
        named, wanted = (
            decode_labels(each.reshape(-1, each.shape[-1]), features.label_embeddings)
            for each in maps
        )
        shares.append((named == wanted).mean())
    # in some views the teacher is wrong about a whole wall, which the others outvote
    assert np.median(shares) > 0.75


def test_features_start_at_nothing_where_no_view_says_anything(up_to_teacher):
    capture, points = Capture.read(up_to_teacher / "ingest"), Points.read(up_to_teacher / "sfm")
    features = Features.read(up_to_teacher / "teacher")
    config = build({"train": {"opacity": 0.7}}, "toy")
    features.pseudo_labels = np.full_like(features.pseudo_labels, -1)
    model = model_of(points, features, config.train, config.describe)
    assert start_features(model, capture, points, features, Progress(False)) == 0
    assert not model.raw["features"].any()
