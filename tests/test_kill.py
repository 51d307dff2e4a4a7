"""Killed at any moment, a run leaves nothing half made that looks whole, and the next one finishes."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
from shared import INPUTS, ROOT, TOY

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


TRAIN = "import chebsplat.stages.resume as r; r.SECONDS = 0.0; from chebsplat.stages.train import main; main()"


@pytest.mark.slow
@pytest.mark.xdist_group("toy")
def test_a_training_killed_at_any_moment_ends_in_the_same_bytes(toy, tmp_path):
    config = TOY | {"train": TOY["train"] | {"steps": 150, "n_densify": 4}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    command = [sys.executable, "-c", TRAIN, "--config", tmp_path / "config.json", "--no-progress"]
    command += [part for role, of in INPUTS["train"].items() for part in (f"--in-{role}", toy[of])]

    def train(out, kill_after=None):
        """Exit code; None if it was killed, so many seconds after it first saved its state."""
        running = subprocess.Popen(
            [*command, "--out", out], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        saved = out.parent / f".part-{out.name}/training.pt"
        while kill_after is not None and running.poll() is None and not saved.is_file():
            time.sleep(0.01)
        try:
            _, error = running.communicate(timeout=kill_after)
        except subprocess.TimeoutExpired:
            running.kill()
            running.communicate()
            return None
        assert running.returncode == 0, error
        return 0

    train(tmp_path / "whole")
    rng, killed = random.Random(0), 0
    while killed < 3 and train(tmp_path / "killed", kill_after=rng.uniform(0.05, 0.6)) is None:
        killed += 1
    train(tmp_path / "killed")
    facts = artifact.read_manifest(tmp_path / "killed").facts
    assert killed >= 1 and facts["resumed_at"]
    for name in ("parameters", "modules", "optimizer"):
        file = f"{name}.safetensors"
        assert (tmp_path / "killed" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), facts
