"""Killed at any moment, a run leaves nothing half made that looks whole, and the next one
finishes.
"""

import json
import random
import subprocess
import sys
import time

import pytest
from shared import INPUTS, TOY
from soak.kills import kills

from chebsplat.formats import artifact


@pytest.mark.slow
def test_kills_and_stops_leave_nothing_half_or_behind_and_a_rerun_gives_the_same_bytes(tmp_path):
    blows, finished = kills(tmp_path, 9, 3)
    assert not [blow for blow in blows if blow.fault]
    assert len(blows) == 12 and finished


TRAIN = (
    "import chebsplat.stages.training.saves as r; r.SECONDS = 0.0; from "
    "chebsplat.pipelines.cli import main; main()"
)


@pytest.mark.slow
@pytest.mark.xdist_group("toy")
def test_a_training_killed_at_any_moment_ends_in_the_same_bytes(toy, tmp_path):
    config = TOY | {"train": TOY["train"] | {"steps": 150, "n_densify": 4}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    command = [sys.executable, "-c", TRAIN, "train", "--config", tmp_path / "config.json"]
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
    resumed, whole = (artifact.read_manifest(tmp_path / name) for name in ("killed", "whole"))
    assert killed >= 1 and resumed.facts["resumed_at"]
    assert resumed.files.keys() == whole.files.keys()
    others = {name for name in whole.files if resumed.files[name] != whole.files[name]}
    assert others == {"log.jsonl", "trace.csv"}  # which tell the time
