"""A training's progress line is steady and says what it shows; a training that is stopped saves its
state first.
"""

import os
import signal
from types import SimpleNamespace

import pytest
import torch

from chebsplat.errors import Stopped
from chebsplat.settings import TrainSection
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.runtime.stopping import heeded
from chebsplat.stages.training.loop import follow

SETTINGS = TrainSection(report_every=6)


class Alternating:
    """A trainer of 12 steps, of which every fourth has a loss that the others have not."""

    reads = True

    def __init__(self, stop_at=None):
        self.step, self.seconds, self.stop_at, self.settings = 0, 0.0, stop_at, SETTINGS
        self.views, self.feature_every = SimpleNamespace(names=["a", "b"]), 4
        self.model = SimpleNamespace(sh_kept=lambda: 0.5)
        self.schedule = SimpleNamespace(last_step=lambda step, seconds: 12)

    @property
    def share(self):
        return self.step / 12

    def steps(self):
        while self.step < 12:
            self.step += 1
            if self.step == self.stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            yield {"loss": 9.0 if self.step % 4 == 0 else 1.0, "n": 5}

    def held_in_psnr(self, indices):
        return 30.0

    def state_dict(self):
        return {"step": self.step}


class Lines(Progress):
    def __init__(self):
        super().__init__(show=False)
        self.lines = []

    def track(self, *args, **kwargs):
        for item, status in super().track(*args, **kwargs):
            yield item, status
            self.lines.append(dict(status))


def job(folder):
    return Job({}, configs.Config(), folder / "out", folder / "scratch", progress=Lines())


def test_the_progress_line_does_not_jump_with_terms_that_alternate(tmp_path):
    made = job(tmp_path)
    follow(made, Alternating())
    assert {line["mean loss"] for line in made.progress.lines[3:]} == {"3.0000"}
    assert made.progress.lines[-1]["train PSNR"] == "30.00"


def test_a_training_that_is_stopped_saves_the_step_it_is_at(tmp_path, caplog):
    with pytest.raises(Stopped), heeded(), caplog.at_level("INFO", "chebsplat"):
        follow(job(tmp_path), Alternating(stop_at=5))
    assert "saved at step 5; the same command goes on from there" in caplog.text
    held = torch.load(tmp_path / "scratch/training.pt", weights_only=True)
    assert held["state"]["trainer"]["step"] == 5
