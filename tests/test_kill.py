"""Killed at any moment, a run leaves nothing half made that looks whole, and the next one finishes."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from shared import ROOT

from chebsplat.formats import artifact
from chebsplat.pipelines import store

SET = "train.steps=12,train.n_densify=1,sfm.max_points=200,describe.n_regions=12"
COMMAND = [sys.executable, "-m", "chebsplat.pipelines.cli", "run", "--scene", "toy", "--set", SET]


def run(work, timeout=None):
    environment = os.environ | {"CHEBSPLAT_WORK": str(work)}
    done = subprocess.Popen(COMMAND, cwd=ROOT, env=environment, start_new_session=True,
                            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)  # fmt: skip
    try:
        _, error = done.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(done.pid, signal.SIGKILL)
        done.communicate()
        return None, ""
    return done.returncode, error


@pytest.mark.slow
def test_thirty_kills_leave_no_half_artifact_and_a_rerun_finishes(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    began = time.perf_counter()
    assert run(tmp_path / "warm-up")[0] == 0
    whole = time.perf_counter() - began
    rng, killed, finished, work = random.Random(0), 0, 0, 0
    while killed < 30:
        place = tmp_path / str(work)
        code, error = run(place, timeout=rng.uniform(0.2, 0.7 * whole))
        killed += code is None
        for manifest in place.glob("store/*/*/artifact.json"):
            if not manifest.parent.name.startswith("."):
                artifact.verify(manifest.parent)
        if code is not None:
            assert code == 0, error
        if code is not None or killed % 6 == 0:
            code, error = run(place)
            assert code == 0, error
            finished += 1
            work += 1
    assert finished >= 5
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "0"))
    for path, _ in store.unnamed():
        store.remove(path)
    assert not list((tmp_path / "0/store").glob("*/.*"))
