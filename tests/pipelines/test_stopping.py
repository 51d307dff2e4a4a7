"""A run that is stopped or killed takes all its processes with it, leaves nothing half, and says
what is kept.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from soak.tiny import Run, artifacts, contents, hidden, kill

from chebsplat.errors import Stopped
from chebsplat.pipelines.cli.group import Guarded
from chebsplat.pipelines.running import processes as children
from chebsplat.pipelines.work import store
from chebsplat.stages.runtime import stopping


def in_a_job(run, seconds=120):
    """Wait until a stage is under way."""
    until = time.monotonic() + seconds
    while not hidden(run.work):
        assert run.process.poll() is None, run.stderr
        assert time.monotonic() < until
        time.sleep(0.01)
    return run


@pytest.fixture
def unmuted():
    """Signals as a terminal's shell leaves them, however the tests were started (nohup, in the
    background).
    """
    before = {
        number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)
    }
    before |= {signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.usefixtures("unmuted")
def test_a_stopped_command_says_what_is_kept_and_leaves_as_shells_know_it(number):
    group = Guarded(
        commands={"wait": click.Command("wait", callback=lambda: os.kill(os.getpid(), number))}
    )
    result = CliRunner().invoke(group, ["wait"])
    assert result.exit_code == 128 + number
    assert f"stopped by {number.name}; what was finished is kept" in result.stderr


def is_in_state(number, state):
    return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == state


def test_a_run_pauses_with_its_jobs_and_ends_with_them_and_leaves_nothing_half(tmp_path):
    run = in_a_job(Run(tmp_path / "work"))
    kill(run.process.pid, signal.SIGTSTP)
    until = time.monotonic() + 10
    while not all(is_in_state(number, "T") for number in run.alive()):
        assert time.monotonic() < until
        time.sleep(0.02)
    kill(run.process.pid, signal.SIGCONT)
    kill(run.process.pid, signal.SIGTERM)
    assert run.finish(10) == 143
    assert run.seconds_to_end() < 5
    assert not hidden(run.work)
    assert "stopped by SIGTERM; what was finished is kept" in run.stderr
    assert "Traceback" not in run.stderr
    assert "failed" not in run.stderr
    contents(run.work)


def test_jobs_end_with_a_run_that_is_killed(tmp_path):
    run = in_a_job(Run(tmp_path / "work"))
    kill(run.process.pid, signal.SIGKILL)
    assert run.seconds_to_end() < 5
    made = artifacts(run.work)
    contents(run.work)
    time.sleep(0.5)
    assert artifacts(run.work) == made


BUSY = """
import hashlib, os, sys, time
from chebsplat.stages.runtime.stopping import heeded
with heeded():
    print(os.getpid(), flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
"""


def test_of_a_session_that_is_ended_nothing_is_left_though_it_cannot_listen():
    command = f"{sys.executable} -P -c '{BUSY}' & wait"
    process = subprocess.Popen(
        ["sh", "-c", command], stdout=subprocess.PIPE, start_new_session=True, text=True
    )
    number = int(process.stdout.readline())
    began = time.monotonic()
    children.end(process)
    assert time.monotonic() - began < 2 * stopping.PATIENCE
    assert not Path(f"/proc/{number}").exists() or is_in_state(number, "Z")
    process.stdout.close()


def test_a_signal_is_heeded_where_the_block_looks_for_it():
    seen = []
    with pytest.raises(Stopped) as stop, stopping.heeded(), stopping.deferred() as asked:
        os.kill(os.getpid(), signal.SIGTERM)
        seen.append(asked.stop)
    assert stop.value.exit_code == 143
    assert seen == [stop.value]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_what_breaks_because_of_a_stop_is_the_stop(capsys):
    class Deaf:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    def deaf_then_broken():
        Deaf()
        raise ImportError("partially initialized module")

    result = CliRunner().invoke(
        Guarded(commands={"wait": click.Command("wait", callback=deaf_then_broken)}), ["wait"]
    )
    assert result.exit_code == 143
    assert "Traceback" not in result.stderr + capsys.readouterr().err


def test_a_second_signal_does_not_break_into_the_cleaning_up_after_the_first():
    cleaned = []
    with pytest.raises(Stopped, match="SIGTERM"), stopping.heeded():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            cleaned.append("up")
    assert cleaned


@pytest.mark.usefixtures("unmuted")
def test_a_later_signal_is_heeded_where_a_destructor_lost_the_first(monkeypatch):
    monkeypatch.setattr(stopping, "PATIENCE", 0.0)

    class Deaf:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Stopped, match="SIGINT"), stopping.heeded():
        Deaf()
        os.kill(os.getpid(), signal.SIGINT)


def test_a_reader_that_has_gone_is_no_crash():
    command = f"{sys.executable} -P -m chebsplat.pipelines.cli settings | true"
    assert subprocess.run(command, shell=True, stderr=subprocess.PIPE, text=True).stderr == ""


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopping.heeded():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_runs_leave_beside_the_store_is_swept_when_none_is_under_way(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    for name in (".snakemake/log", ".leases", ".names", f".plans/abc-{os.getpid()}"):
        (tmp_path / name).mkdir(parents=True)
    store.sweep()
    assert (tmp_path / ".snakemake/log").is_dir()
    (tmp_path / f".plans/abc-{os.getpid()}").rmdir()
    store.sweep()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".plans"]
