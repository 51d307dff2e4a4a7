"""A lease has one holder at a time, outlives none, and needs neither locks nor clocks that agree."""

import os
import random
import subprocess
import sys
import threading
import time

import pytest
from shared import ROOT

from chebsplat.pipelines import leases

COUNTING = """
import fcntl, os, sys
from pathlib import Path
from chebsplat.pipelines import leases

def refused(*_):
    raise OSError("no locks here")

fcntl.flock = fcntl.lockf = refused
root, who, inside = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[1]) / "inside"
for number in range(int(sys.argv[3])):
    with leases.held(root / "lease"):
        if inside.exists() and leases.started(int(inside.read_text())):
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
        command = [sys.executable, "-c", COUNTING, tmp_path, str(who), "60"]
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
    assert sorted((tmp_path / "count").read_text().split()) == sorted(f"{w}-{n}" for w in range(4) for n in range(60))


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(leases, "EVERY", 0.1)
    monkeypatch.setattr(leases, "EXPIRES", 1.0)


def elsewhere(folder, number=1):
    """A lease that a process of another machine holds."""
    folder.mkdir(exist_ok=True)
    (folder / str(number)).symlink_to("boot-4026 17 999 token node7")
    beat = folder / f"{number}.beat"
    beat.touch()
    return beat


@pytest.mark.usefixtures("quick")
def test_a_holder_elsewhere_lives_as_long_as_its_beat_moves_whatever_its_clock_says(tmp_path):
    beat, over = elsewhere(tmp_path / "lease"), threading.Event()

    def wander():
        stamp = 10**9
        while not over.wait(0.1):
            stamp = -stamp if stamp > 0 else 10**18 - stamp
            os.utime(beat, ns=(abs(stamp), abs(stamp)))

    thread = threading.Thread(target=wander)
    thread.start()
    try:
        assert leases.is_held(tmp_path / "lease")
    finally:
        over.set()
        thread.join()
    os.utime(beat, (4e9, 4e9))  # the far future, and never again
    began = time.monotonic()
    assert not leases.is_held(tmp_path / "lease")
    assert time.monotonic() - began > 0.9


@pytest.mark.usefixtures("quick")
def test_who_waits_is_told_for_which_machine_and_follows_when_it_falls_silent(tmp_path):
    elsewhere(tmp_path / "lease")
    told = []
    with leases.held(tmp_path / "lease", told.append):
        assert told == ["node7"]
        assert leases.newest_of(tmp_path / "lease") == 2
        assert leases.is_held(tmp_path / "lease")
    assert not leases.is_held(tmp_path / "lease")


def test_who_is_done_is_followed_at_once_and_no_number_is_taken_twice(tmp_path):
    began = time.monotonic()
    for number in range(1, 4):
        with leases.held(tmp_path / "lease"):
            assert leases.newest_of(tmp_path / "lease") == number
            time.sleep(0.01)
    elsewhere(tmp_path / "lease", 4).rename(tmp_path / "lease/4.over")
    assert not leases.is_held(tmp_path / "lease")
    assert time.monotonic() - began < leases.EXPIRES / 4


def test_another_process_of_a_dead_one_s_number_holds_nothing(tmp_path):
    (tmp_path / "1").symlink_to(f"{leases.here()} {os.getpid()} 1 token here")
    assert leases.started(os.getpid()) != "1"
    assert not leases.is_held(tmp_path)
