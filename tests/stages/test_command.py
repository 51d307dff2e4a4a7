"""A stage command publishes one artifact, prints its path and nothing else, and ends with the
documented exit code.
"""

import json
import logging

import pytest
from click.testing import CliRunner
from shared import KEY

from chebsplat.errors import DataFailure
from chebsplat.formats import artifact
from chebsplat.stages.runtime.command import Planned, command, publish


@pytest.fixture(autouse=True)
def _release_logging():
    yield
    logging.getLogger().handlers.clear()


def invoke(run, *arguments, stage="ingest"):
    return CliRunner().invoke(command(stage, run), [str(a) for a in arguments])


def good(job):
    (job.out / "a.txt").write_text("a")
    job.left_out("depth", "none given")


def test_artifact_is_published_and_its_path_printed(tmp_path):
    result = invoke(good, "--out", tmp_path / "x")
    assert (result.exit_code, result.stdout) == (0, f"{tmp_path / 'x'}\n")
    manifest = artifact.verify(tmp_path / "x", "chebsplat.capture/2")
    assert (len(manifest.key), manifest.facts) == (16, {"left_out": {"depth": "none given"}})
    assert set(manifest.config) == {"scene", "source", "ingest"}


@pytest.mark.parametrize(("verbose", "lines"), [("", 0), ("1", 1)])
def test_what_a_scene_leaves_out_is_on_the_console_only_with_v(
    tmp_path, monkeypatch, verbose, lines
):
    monkeypatch.setenv("CHEBSPLAT_VERBOSE", verbose)
    assert invoke(good, "--out", tmp_path / "x").stderr.count("left out: depth") == lines


def test_called_from_python_a_stage_prints_nothing_and_raises_typed_errors(tmp_path, capsys):
    publish("ingest", good, tmp_path / "x", {}, planned=Planned(KEY))
    assert artifact.verify(tmp_path / "x", "chebsplat.capture/2").key == KEY
    with pytest.raises(DataFailure):
        publish("ingest", fail_data, tmp_path / "y", {})
    assert not (tmp_path / "y").exists()
    assert capsys.readouterr().out == ""


def test_finished_artifact_is_not_made_again_unless_forced(tmp_path):
    runs = []

    def counted(job):
        runs.append(1)
        good(job)

    for extra in ([], [], ["--force"]):
        assert invoke(counted, "--out", tmp_path / "x", *extra).exit_code == 0
    assert len(runs) == 2


def test_force_keeps_what_stands_there_until_the_new_one_is_there(tmp_path):
    assert invoke(good, "--out", tmp_path / "x").exit_code == 0
    assert invoke(fail_data, "--out", tmp_path / "x", "--force").exit_code == 4
    artifact.verify(tmp_path / "x")


def fail_data(job):
    raise DataFailure("3 of 9 views registered")


def crash(job):
    raise RuntimeError("bug")


@pytest.mark.parametrize(("run", "code"), [(fail_data, 4), (crash, 1)])
def test_failed_run_publishes_nothing(tmp_path, run, code):
    result = invoke(run, "--out", tmp_path / "x")
    assert (result.exit_code, result.stdout) == (code, "")
    assert not list(tmp_path.iterdir())


def test_log_is_part_of_the_artifact(tmp_path):
    def logs(job):
        for step, status in job.progress.track(range(3), 3, "steps"):
            status["loss"] = 0.5
            job.progress.record(step=step)

    assert invoke(logs, "--out", tmp_path / "x").exit_code == 0
    lines = (tmp_path / "x/log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, 1, 2]
