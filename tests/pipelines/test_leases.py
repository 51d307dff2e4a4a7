"""A lease has one holder at a time, and outlives none."""

import os
import socket
import subprocess
import sys
import time

import pytest

from chebsplat.pipelines.work import leases, store

ENDLESS = """
import sys, time
from pathlib import Path
from chebsplat.pipelines.work import leases
with leases.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_who_is_killed_is_followed_at_once_and_nobody_before(tmp_path):
    path = tmp_path / "held/lease"
    holder = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, path], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    told = []

    def kill(machine):
        time.sleep(0.2)
        told.append((machine, leases.holder(path)))
        holder.kill()
        holder.communicate()

    with leases.hold(path, kill):
        assert told == [(socket.gethostname(), socket.gethostname())]
        assert leases.holder(path) == socket.gethostname()
    assert leases.holder(path) is None
    assert list(path.parent.iterdir()) == []


def elsewhere(path):
    """A lease that a process of another machine holds."""
    path.parent.mkdir(exist_ok=True)
    seconds = leases.EXPIRES
    path.write_text(f"filelock/2\npid=17\nhost=node7\nmode=lease\ntoken=0\nduration={seconds}\n")
    return path


def test_a_holder_elsewhere_lives_as_long_as_it_gives_signs_of_life(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    path = elsewhere(tmp_path / ".held/run")
    assert leases.holder(path) == store.holder(path) == "node7"
    store.sweep()
    assert path.exists()
    os.utime(path, (time.time() - 61, time.time() - 61))
    assert not store.holder(path)
    store.sweep()
    assert not path.exists()


@pytest.mark.parametrize("machine", ["node7", None])  # None: it was killed before it could say
def test_who_is_silent_elsewhere_is_followed_after_a_while(tmp_path, monkeypatch, machine):
    monkeypatch.setattr(leases, "EVERY", 0.1)
    monkeypatch.setattr(leases, "EXPIRES", 1.0)
    path, told, began = elsewhere(tmp_path / "lease"), [], time.monotonic()
    if machine is None:
        path.write_text("")
    with leases.hold(path, told.append):
        assert told == [machine or "this machine"]
        assert time.monotonic() - began >= leases.EXPIRES
