"""A lease has one holder at a time, and outlives none."""

import os
import random
import socket
import subprocess
import sys
import threading
import time

import pytest
from shared import ROOT

from chebsplat.pipelines import leases, store

COUNTING = """
import os, sys
from pathlib import Path
from chebsplat.pipelines import leases

root, who, inside = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[1]) / "inside"
for number in range(int(sys.argv[3])):
    with leases.held(root / "lease"):
        if inside.exists() and os.path.exists(f"/proc/{inside.read_text()}"):
            sys.exit("two at once")
        fresh = inside.with_name(f"inside-{who}")
        fresh.write_text(str(os.getpid()))
        os.replace(fresh, inside)
        text = (root / "count").read_text()
        if f" {who}-{number} " not in text:
            fresh.write_text(f"{text}{who}-{number} ")
            os.replace(fresh, root / "count")
        inside.unlink()
"""


def test_of_processes_that_are_killed_one_at_a_time_holds_a_lease_and_nothing_is_lost(tmp_path):
    (tmp_path / "count").write_text(" ")

    def start(who):
        command = [sys.executable, "-c", COUNTING, tmp_path, str(who), "20"]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)

    running, rng, killed = {who: start(who) for who in range(4)}, random.Random(0), 0
    while running:
        time.sleep(rng.uniform(0, 0.2))
        for who, process in list(running.items()):
            if process.poll() is not None:
                _, error = process.communicate()
                assert process.returncode == 0, error
                del running[who]
        if running and killed < 12:
            who = rng.choice(sorted(running))
            running[who].kill()
            running[who].communicate()
            running[who] = start(who)
            killed += 1
    assert killed >= 1
    assert sorted((tmp_path / "count").read_text().split()) == sorted(f"{w}-{n}" for w in range(4) for n in range(20))


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(leases, "EVERY", 0.1)
    monkeypatch.setattr(leases, "EXPIRES", 1.0)


def elsewhere(path):
    """A lease that a process of another machine holds."""
    path.parent.mkdir(exist_ok=True)
    path.write_text("filelock/2\npid=17\nhost=node7\nmode=lease\ntoken=0\nduration=1.0\n")
    return path


@pytest.mark.usefixtures("quick")
def test_a_holder_elsewhere_lives_as_long_as_it_gives_signs_of_life(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    path = elsewhere(tmp_path / ".held/run")
    assert leases.holder(path) == "node7" and store.is_held(path)
    store.sweep()
    assert path.exists()
    os.utime(path, (time.time() - 2, time.time() - 2))
    assert not store.is_held(path)
    store.sweep()
    assert not path.exists()


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("said", [None, ""])  # whoever was killed may have said nothing
def test_who_waits_is_told_for_which_machine_and_follows_when_it_falls_silent(tmp_path, said):
    path, told = elsewhere(tmp_path / "lease"), []
    if said is not None:
        path.write_text(said)
    with leases.held(path, told.append):
        assert told == ["node7" if said is None else "this machine"]
        assert leases.holder(path) == socket.gethostname()
    assert leases.holder(path) is None
    assert list(tmp_path.iterdir()) == []


def test_who_is_done_is_followed_at_once(tmp_path):
    with leases.held(tmp_path / "lease"):
        waiting, told = threading.Event(), []

        def wait():
            with leases.held(tmp_path / "lease", lambda machine: waiting.set()):
                told.append(time.monotonic())

        thread = threading.Thread(target=wait)
        thread.start()
        assert waiting.wait(10)
        done = time.monotonic()
    thread.join()
    assert 0 <= told[0] - done < 5
