"""Threads share a kernel's work: every part once, failures told, in a forked process too."""

import subprocess
import sys

import numpy as np
import pytest

from chebsplat.kernels.threads import in_every_thread, in_parts, n_threads, set_n_threads


@pytest.fixture(params=[1, 2, 7])
def threads(request):
    set_n_threads(request.param)
    yield request.param
    set_n_threads(0)


@pytest.mark.parametrize("n", [0, 1, 2, 6, 7, 1000])
def test_every_number_belongs_to_one_part(threads, n):
    counts, parts = np.zeros(n, int), []

    def count(first, last, name):
        counts[first:last] += 1
        parts.append((first, last, name))

    in_parts(count, n, "a")
    assert (counts == 1).all()
    assert len(parts) == max(min(threads, n), 1)
    assert max(last - first for first, last, _ in parts) <= -(-n // threads)


def test_there_is_a_call_for_each_thread(threads):
    calls = []
    in_every_thread(calls.append, "once")
    assert calls == ["once"] * threads


def test_a_failure_is_raised_when_all_are_done_and_the_threads_go_on(threads):
    done = []

    def fail(first, last):
        done.append(first)
        if last == 14:
            raise MemoryError("no room for the last part")

    for _ in range(3):
        with pytest.raises(MemoryError, match="last part"):
            in_parts(fail, 14)
    assert len(done) == 3 * threads


def test_the_environment_says_how_many_and_else_the_cores_do(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert n_threads() == 5
    monkeypatch.setattr("chebsplat.kernels.threads.cores", lambda: 3)
    for unusable in ("", "0", "4,2"):
        monkeypatch.setenv("OMP_NUM_THREADS", unusable)
        assert n_threads() == 3


def test_a_forked_process_has_threads_of_its_own():
    program = """
import os, warnings
from chebsplat.kernels.threads import in_every_thread, set_n_threads
warnings.simplefilter("ignore")
set_n_threads(3)
in_every_thread(int)
if child := os.fork():
    os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
calls = []
in_every_thread(calls.append, 1)
os._exit(40 + len(calls))
"""
    done = subprocess.run([sys.executable, "-c", program], timeout=60)
    assert done.returncode == 43
