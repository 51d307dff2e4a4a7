"""A study says how far it is."""

import threading
from types import SimpleNamespace

import pytest

from chebsplat.errors import DataFailure
from chebsplat.pipelines.studies import study
from chebsplat.pipelines.studies.study import report_progress


@pytest.fixture
def runs():
    return [
        SimpleNamespace(name=f"run-{k}", steps=[SimpleNamespace(fresh=False)]) for k in range(3)
    ]


def finish(run):
    run.steps[-1].fresh = True


def test_every_run_is_told_once_when_it_is_done(runs):
    told = []
    finish(runs[0])
    with report_progress(runs, told.append):  # the first was there before
        finish(runs[1])
    with report_progress(runs, told.append):
        finish(runs[2])
    assert told == ["  2 of 3 done: run-1", "  3 of 3 done: run-2"]


def test_what_shows_the_runs_is_written_while_they_go_on_and_a_failure_of_that_is_told(
    runs, monkeypatch
):
    monkeypatch.setattr(study, "EVERY", 0.01)
    monkeypatch.setattr(study, "REFRESH", 0.02)
    told, written = [], threading.Event()

    def refresh():
        written.set()
        raise DataFailure("no room")

    with report_progress(runs, told.append, refresh):
        assert not written.wait(0.2)  # nothing new
        finish(runs[0])
        assert written.wait(20)
    assert told == ["  1 of 3 done: run-0", "  the page could not be written: no room"]
