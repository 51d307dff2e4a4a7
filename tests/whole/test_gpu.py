"""On a GPU, a training is the one in plain torch on the CPU, through the real gsplat."""

import chebsplat  # noqa: F401  # isort: skip
import pytest
import torch

from benchmarks.training.cost import trainer_from
from chebsplat.stages.runtime import config as configs

pytestmark = pytest.mark.gpu
SETTINGS = {"densify": "off", "prune_from": 0.1}


@pytest.fixture
def trainer_on(up_to_teacher):
    """Makes a trainer of the toy scene before its first step, by device and settings."""

    def make(device, **settings):
        chosen = configs.build({"train": SETTINGS | settings}, "toy")
        return trainer_from(
            up_to_teacher, chosen, "auto" if device == "cuda" else "reference", device=device
        )

    return make


def test_gradients_of_a_first_step_are_those_in_plain_torch(trainer_on):
    found, wanted = ({}, {})
    for device, gradients in (("cuda", found), ("cpu", wanted)):
        made = trainer_on(device, steps=10)
        next(made.steps())
        gradients |= {
            name: value.grad.cpu()
            for name, value in made.model.raw.items()
            if value.grad is not None
        }
    assert found.keys() == wanted.keys()
    # gsplat's exponential is approximate, its covariances are float32
    for name, expected in wanted.items():
        assert (found[name] - expected).norm() < 1e-3 * expected.norm(), name


def test_a_recorded_step_has_the_gradients_of_a_plain_one(trainer_on):
    made = trainer_on("cuda", steps=200, feature_every=2, depth_every=2, refresh_every=1000)
    steps = made.steps()
    while made.step < 60:
        next(steps)
    assert any(recording.graph is not None for recording in made.model.replay.recordings.values())
    for index in (0, 5):
        found = []
        for records in (True, False):
            made.model.replay.records = records
            made.optimizer.zero_grad(set_to_none=True)
            loss = made.losses_of(index, made.share)[1]["loss"]
            loss.backward()
            found.append(
                {name: value.grad.clone() for name, value in made.model.raw.items()}
                | {"loss": loss.detach()}
            )
        # gsplat adds gradients up in the order in which threads arrive
        for name, wanted in found[1].items():
            assert (found[0][name] - wanted).norm() <= 1e-4 * wanted.norm(), name


def test_two_hundred_steps_reach_the_same_psnr(trainer_on):
    reached = []
    for device in ("cuda", "cpu"):
        made = trainer_on(device, steps=200)
        for _ in made.steps():
            pass
        reached.append(made.held_in_psnr(list(range(len(made.views.names)))))
    assert abs(reached[0] - reached[1]) < 0.05  # dB


def test_growth_pruning_freeze_and_finish_run(trainer_on):
    made = trainer_on(
        "cuda", steps=60, densify="mixed", densify_from=0.1, densify_until=0.6, grow_threshold=1e-6
    )
    for _ in made.steps():
        pass
    assert made.population.n_added > 0
    assert all(
        torch.from_numpy(value.astype("f4")).isfinite().all() for value in made.finish().values()
    )
