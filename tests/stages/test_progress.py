"""Long work shows rate and time left: a bar on a terminal, plain lines elsewhere, and the log
always; nothing is silent for long.
"""

import json
import logging
import time

import pytest

from chebsplat.stages.runtime.progress import Progress, duration


def work(progress, n=3):
    for item, status in progress.track(range(n), n, "work"):
        status["loss"] = item


def test_a_terminal_gets_one_line_that_is_rewritten(capsys):
    work(Progress(show=True, expected=300))
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "\r" in error
    assert "work 3/3  loss 2" in error
    assert "about 5 min left" in error


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
    with Progress(show=True).ticker(3, "poses") as tick:
        for _ in range(5):
            tick()
    error = capsys.readouterr().err
    assert "poses 3/3" in error and "4/3" not in error and error.count("\n") == 1


def test_a_ticker_of_fewer_steps_than_expected_leaves_no_bar(capsys):
    progress = Progress(show=True, every=0.2)
    with progress.alive():
        with progress.ticker(10, "poses") as tick:
            for _ in range(4):
                time.sleep(0.25)
                tick()
        shown = capsys.readouterr().err
        time.sleep(0.6)
    assert "poses 4/10" in shown and shown.endswith("\n")
    assert "poses" not in capsys.readouterr().err


def test_work_that_is_resumed_tells_what_is_left_by_its_own_rate(caplog):
    progress = Progress(show=False, every=0.0, expected=600)
    with caplog.at_level(logging.INFO, "chebsplat"):
        for _ in progress.track(range(90, 100), 100, "teacher", 90):
            time.sleep(0.02)
    assert "about 5 s left" in caplog.text and "min left" not in caplog.text


@pytest.mark.parametrize("show", [False, True])
def test_work_that_counts_nothing_says_now_and_then_that_it_goes_on(caplog, show):
    progress = Progress(show=show, every=0.2, expected=30)
    with caplog.at_level(logging.INFO, "chebsplat"), progress.alive():
        time.sleep(1.0)
    lines = [record.getMessage() for record in caplog.records]
    assert 3 <= len(lines) <= 6
    assert lines[:2] == ["about 30 s left", "0 s so far  about 30 s left"]
    time.sleep(0.4)
    assert len(caplog.records) == len(lines)  # nothing once it is over


def test_a_bar_that_stands_still_shows_that_time_goes_on(capsys, monkeypatch):
    # handlers of tests before have streams that are closed
    monkeypatch.setattr(logging.getLogger("chebsplat"), "handlers", [])
    monkeypatch.setattr(logging.getLogger("chebsplat"), "propagate", False)
    progress = Progress(show=True, every=0.3)
    with progress.alive():
        for _ in progress.track(range(2), 3, "work"):
            time.sleep(0.9)
    error = capsys.readouterr().err
    assert "\r\x1b[Kwork 1/3  1 s so far" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("expected", "elapsed", "ran", "rest", "said"),
    [
        (None, 10, 0, None, ""),  # nothing is known
        (None, 10, 5, 20, "  about 20 s left"),  # the rate alone
        (100, 40, 0, None, "  about 60 s left"),  # the forecast alone
        (100, 10, 2, 900, "  about 2 min left"),  # one slow batch of a stage that has just begun
        (100, 60, 50, 90, "  about 65 s left"),  # both, as much as each is worth
        (100, 130, 100, 40, "  about 40 s left"),  # longer than expected: the rate alone
        (100, 130, 0, None, ""),
    ],
)
def test_time_left_is_the_forecast_until_the_rate_is_known(expected, elapsed, ran, rest, said):
    progress = Progress(show=False, expected=expected)
    progress.began -= elapsed
    assert progress._left(ran, rest) == said


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0, "5 s"), (42, "40 s"), (99, "100 s"), (100, "2 min"), (720, "12 min"), (9000, "2.5 h")],
)
def test_times_are_said_as_people_say_them(seconds, said):
    assert duration(seconds) == said
