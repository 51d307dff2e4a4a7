"""Long work shows rate and ETA: a bar on a terminal, plain lines elsewhere, and the log always."""

import json
import logging

from chebsplat.stages.runtime.progress import Progress


def work(progress, n=3):
    for item, status in progress.track(range(n), n, "work"):
        status["loss"] = item


def test_a_terminal_gets_one_line_that_is_rewritten(capsys):
    work(Progress(show=True))
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "\r" in error
    assert "work 3/3  loss 2" in error
    assert "ETA" in error


def test_elsewhere_lines_are_logged_now_and_then_and_at_the_end(caplog):
    with caplog.at_level(logging.INFO, "chebsplat"):
        work(Progress(show=False, every=1e9))
    assert [record.getMessage().split("  ")[0] for record in caplog.records] == ["work 3/3"]


def test_without_stderr_there_is_no_bar_and_no_crash(monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    assert Progress().show is False


def test_records_become_lines_of_json(tmp_path):
    progress = Progress(show=False)
    with progress.log_to(tmp_path / "log.jsonl"):
        progress.record(step=1, loss=0.5)
        progress.record(step=2, loss=0.25)
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["loss"] for line in lines] == [0.5, 0.25]
    progress.record(step=3)


def test_a_ticker_shows_what_a_library_counts_and_nothing_beyond_its_total(capsys):
    tick = Progress(show=True).ticker(3, "poses")
    for _ in range(5):
        tick()
    error = capsys.readouterr().err
    assert "poses 3/3" in error and "4/3" not in error and error.count("\n") == 1
