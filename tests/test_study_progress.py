"""A study says how far it is, and how long the rest takes."""

import json
import threading
from types import SimpleNamespace

import pytest

from chebsplat.errors import DataFailure
from chebsplat.pipelines.studies import progress as progresses
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


def test_what_shows_the_runs_is_written_while_they_go_on_and_a_failure_of_that_is_told(runs, monkeypatch):
    monkeypatch.setattr(progresses, "EVERY", 0.01)
    monkeypatch.setattr(progresses, "REFRESH", 0.02)
    told, written = [], threading.Event()

    def refresh():
        written.set()
        raise DataFailure("no room")

    with reported(runs, 1, told.append, refresh):
        assert not written.wait(0.2)  # nothing new
        for one in runs[0].steps:
            finish(one, 1.0)
        assert written.wait(20)
    assert told[0].startswith("  run 1 of 3 is done") and told[1:] == ["  the page could not be written: no room"]


def test_a_damaged_manifest_counts_as_not_done(runs):
    runs[0].steps[-1].path.mkdir()
    (runs[0].steps[-1].path / "artifact.json").write_text("[]")
    assert len(Progress(runs, 1, print).waiting) == 3


def test_times_are_said_in_the_unit_that_fits():
    assert [estimate_text(s) for s in (0.2, 40, 700, 10_000)] == ["1 s", "40 s", "12 min", "2.8 h"]
