"""A plan says before it runs how long it takes and what it writes, by what is known then."""

import json
import os
import shutil
from dataclasses import asdict

import pytest
from click.testing import CliRunner
from PIL import Image
from shared import ROOT, data, photo_folder, remember

from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning import forecast as forecasts
from chebsplat.pipelines.planning.forecast import facts_of, forecast, sentence
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import store
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.machine import processor
from chebsplat.stages.sources.common import is_photo


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch, code_memo):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)
    return remember(tmp_path / "work", code_memo)


def sections(scene, settings=""):
    return {step.stage: step.sections for step in Planner().plan(scene, settings).steps}


def expected(scene, settings="", cores=2, device="cpu"):
    plan = Planner().plan(scene, settings)
    return plan, forecast(plan, plan.steps, cores, device)


# Seconds of all stages in manifests of finished scenes, each as if its process had been alone on
# the two cores (`idle_seconds`): AMD EPYC, torch 2.13.0, default recipe, November 2026.
MEASURED = [
    ("office0", "", 65),
    ("fox", "", 110),
    ("fox", "ingest.max_side=1600", 213),
    ("redkitchen", "", 255),
    ("house_kitchen", "refine.start=trained", 139),
]


@pytest.mark.parametrize(
    ("scene", "settings", "seconds"),
    [
        pytest.param(*row, marks=[pytest.mark.data] if row[0] != "office0" else [])
        for row in MEASURED
    ],
)
def test_a_forecast_is_within_a_factor_of_one_and_a_half_of_what_was_measured(
    scene, settings, seconds
):
    _, found = expected(scene if scene == "office0" else f"{data(scene)}/", settings)
    assert 1 / 1.5 < sum(found.seconds.values()) / seconds < 1.5


@pytest.mark.parametrize(
    ("more", "fewer"),
    [
        ("train.steps=3000", "train.steps=500"),
        ("train.max_gaussians=80000", "train.max_gaussians=10000"),
        ("train.method=printed", ""),
        ("ingest.max_views=60", "ingest.max_views=20"),
        ("train.seconds=600", "train.seconds=60"),
    ],
)
def test_more_work_is_expected_to_take_longer(more, fewer):
    totals = [expected("office0", settings)[1].total for settings in (more, fewer)]
    assert totals[0] > 1.1 * totals[1]


def test_a_training_by_the_clock_takes_what_it_is_given():
    assert STAGES["train"].seconds(facts_of(sections("office0", "train.seconds=600"), True)) == 600


@pytest.mark.parametrize(
    ("path", "photo"),
    [
        ("images/a.jpg", True),
        ("IMG_1.JPG", True),
        ("frame-000001.color.jpg", True),
        ("frame-000001.depth.png", False),
        ("masks/a.jpg.png", False),
        ("results/depth000001.png", False),
        ("label-filt/1.png", False),
        ("Sequence_1/semantic_class/semantic_class_1.png", False),
    ],
)
def test_masks_depth_and_labels_are_no_photos(tmp_path, path, photo):
    assert is_photo(tmp_path / "depth of field" / path, tmp_path / "depth of field") == photo


def test_many_photos_are_said_to_be_many_and_what_fewer_would_save(tmp_path):
    folder = photo_folder(tmp_path / "photos")
    plan, found = expected(folder)
    few = sentence(plan, found, 2, "cpu")
    assert "max_views" not in few and "colour only: for names run `chebsplat get-teacher" in few
    Image.new("RGB", (1280, 960)).save(tmp_path / "photo.jpg")
    for k in range(300):
        shutil.copy(tmp_path / "photo.jpg", tmp_path / "photos" / f"more{k}.jpg")
    plan, found = expected(folder)
    said = sentence(plan, found, 1, "cpu")
    assert said.startswith(f"{found.photos} photos, about ") and found.photos > 300
    assert " on 1 core, " in said and said.endswith("less: set=pose.max_views=150")
    assert 0 < found.saved < found.total
    told = expected(folder, "pose.max_views=150")[1]
    assert told.photos == 150
    assert sum(told.seconds.values()) == pytest.approx(sum(found.seconds.values()) - found.saved)
    last = [step for step in plan.steps if step.stage not in ("pose", "ingest")]
    assert forecast(plan, last, 1, "cpu").saved == 0


# Most MB of the largest process of a scene, by its manifests; Intel Xeon, one thread, torch 2.13.0,
# trainings of 500 steps, November 2026.
MEMORY = [
    ("office0", "", 1053),
    ("fox", "", 1365),
    ("fox", "ingest.max_side=1600", 2073),
    ("house_kitchen", "", 1054),
]


@pytest.mark.parametrize(
    ("scene", "settings", "megabytes"),
    [pytest.param(*row, marks=[pytest.mark.data] if row[0] != "office0" else []) for row in MEMORY],
)
def test_forecast_memory_is_within_a_fifth_of_what_was_measured(scene, settings, megabytes):
    if scene != "office0":
        data(scene)
    plan, found = expected(scene, settings)
    assert found.memory == pytest.approx(megabytes, rel=0.2)
    assert f", about {found.memory / 1000:.1f} GB of memory" in sentence(plan, found, 2, "cpu")


def test_a_training_that_reads_no_features_is_expected_to_be_one_of_colours():
    seconds, megabytes = [], []
    for settings in ("", "train.features=lifted", "teacher.kind=none"):
        plan = Planner().plan("office0", settings)
        training = [step for step in plan.steps if step.stage == "train"]
        found = forecast(plan, training, 2, "cpu")
        seconds.append(found.seconds["train"])
        megabytes.append(found.megabytes)
    assert seconds[1] == seconds[2] < seconds[0] and megabytes[1] == megabytes[2] < megabytes[0]


def test_a_folder_whose_photos_cannot_be_read_has_no_forecast_and_says_so(tmp_path):
    folder = photo_folder(tmp_path / "photos")
    for path in (tmp_path / "photos").iterdir():
        path.write_bytes(b"no image")
    plan, found = expected(folder)
    assert found is None and "no forecast" in sentence(plan, found, 2, "cpu")


def finished(scene, factor, threads=2, load=0.5):
    """Links in work of a scene whose stages have taken `factor` times what is expected of them."""
    of = facts_of(sections(scene), True)
    for step in Planner().plan(scene).steps:
        stage = STAGES[step.stage]
        seconds = factor * stage.seconds(of)
        machine = {"processor": processor(), "gpu": "", "cores": 2, "threads": threads}
        processes = [machine | {"load": [load, load], "seconds": seconds}]
        inputs = {role: {"key": path.name, "schema": "s/1"} for role, path in step.inputs.items()}
        manifest = Manifest(stage.schema, step.key, step.stage, inputs, config=step.sections)
        manifest.processes, manifest.seconds = processes, seconds
        step.path.mkdir(parents=True)
        (step.path / "artifact.json").write_text(json.dumps(asdict(manifest)))
    store.link("done", {})
    for step in Planner().plan(scene).steps:
        os.symlink(step.path, store.work() / "done" / step.stage)


@pytest.mark.parametrize(
    ("made", "low", "high"),
    [
        ({"factor": 3}, 2.0, 3.0),  # the default counts as 20 s of each stage
        ({"factor": 3, "load": 6}, 0.95, 1.05),  # three wanted each core
        ({"factor": 3, "threads": 1}, 1, 1),
    ],
)
def test_what_this_machine_has_finished_corrects_the_forecast(made, low, high):
    before = expected("shuffled0")[1].seconds["train"]
    finished("office0", **made)
    assert low <= expected("shuffled0")[1].seconds["train"] / before <= high


def test_the_plan_and_the_run_begin_with_the_forecast(monkeypatch):
    shown = CliRunner().invoke(main, ["plan", "--scene", "toy", "--device", "cpu"])
    assert shown.stdout.splitlines()[0].startswith("toy: 16 photos, about ")
    said, entries = [], []
    from chebsplat.pipelines.running import run

    monkeypatch.setattr(run, "say", said.append)
    monkeypatch.setattr(
        run, "snakemake", lambda steps, *a, **k: entries.extend(steps) or run.Outcome(1)
    )
    assert run.execute([Planner().plan("toy")], None, 2) == 1
    assert said[0].startswith("toy: 16 photos, about ") and " on 2 cores, " in said[0]
    assert all(run.entry(step, {})["expected"] > 0 for step in entries) and entries


def test_more_cores_and_a_gpu_shorten_what_uses_them():
    two, eight = expected("office0")[1].seconds, expected("office0", cores=8)[1].seconds
    gpu = expected("office0", device="cuda")[1].seconds
    assert all(eight[stage] < two[stage] for stage in two)
    assert {stage for stage in two if gpu[stage] < two[stage]} == {
        stage for stage in two if STAGES[stage].on_device
    }
    assert forecasts.BEGIN * len(two) == pytest.approx(
        expected("office0")[1].total - sum(two.values())
    )


def test_a_scene_that_is_finished_takes_no_time():
    plan = Planner().plan("toy")
    assert sentence(plan, forecast(plan, [], 2, "cpu"), 2, "cpu") == "16 photos, all is done"
