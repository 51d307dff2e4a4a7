"""A study says how far it is, and how long the rest takes."""

import json
from types import SimpleNamespace

import pytest

from chebsplat.pipelines.studies.progress import Progress, estimate_text, reported


def step(folder, stage, name, **train):
    sections = {"train": {"steps": 100, "seconds": None} | train} if stage == "train" else {}
    return SimpleNamespace(stage=stage, key=f"{stage}-{name}", path=folder / f"{stage}-{name}", sections=sections)


def finish(one, seconds):
    one.path.mkdir()
    (one.path / "artifact.json").write_text(json.dumps({"seconds": seconds}))


@pytest.fixture
def runs(tmp_path):
    """Three runs that share their first step; the last trains three times as long."""
    shared = step(tmp_path, "ingest", "all")
    return [
        SimpleNamespace(
            name=f"run-{k}",
            steps=[shared, step(tmp_path, "train", k, steps=n), step(tmp_path, "evaluate", k)],
        )
        for k, n in enumerate((100, 100, 300))
    ]


def test_the_time_left_is_that_of_steps_like_those_that_are_finished(runs):
    progress = Progress(runs, 2, print)
    assert progress.left() is None
    for one, seconds in zip(runs[0].steps, (4.0, 30.0, 6.0), strict=True):
        finish(one, seconds)
    assert progress.left() == (30 + 6 + 90 + 6) / 2
    assert Progress(runs, None, print).left() is None  # on a cluster


def test_every_run_is_told_once_when_it_is_done(runs):
    told = []
    for one in runs[0].steps:
        finish(one, 1.0)
    with reported(runs, 1, told.append):  # the first was there before
        for one in runs[1].steps[1:]:
            finish(one, 10.0)
    progress = Progress(runs, 1, told.append)
    for one in runs[2].steps[1:]:
        finish(one, 10.0)
    progress.look()
    progress.look()
    assert told == ["  run 2 of 3 is done: run-1; about 22 s left", "  run 3 of 3 is done: run-2"]


def test_a_damaged_manifest_counts_as_not_done(runs):
    runs[0].steps[-1].path.mkdir()
    (runs[0].steps[-1].path / "artifact.json").write_text("[]")
    assert len(Progress(runs, 1, print).waiting) == 3


def test_times_are_said_in_the_unit_that_fits():
    assert [estimate_text(s) for s in (0.2, 40, 700, 10_000)] == ["1 s", "40 s", "12 min", "2.8 h"]
