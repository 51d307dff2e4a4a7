"""Rounded light looks to the cameras more as it was than with each coefficient rounded alone."""

import numpy as np
import pytest
import torch
from shared import gaussian_parameters

from chebsplat.splats.rounded import ALONE, STEP, rounded_light
from chebsplat.splats.sh import eval_sh


def seen(parameters, eyes):
    """Colours [V, N, 3] from each eye."""
    sh0, shN, means = (torch.from_numpy(parameters[name]) for name in ("sh0", "shN", "means"))
    views = [eval_sh(sh0, shN, means - torch.from_numpy(eye).float(), 3) for eye in eyes]
    return np.stack([view.numpy() for view in views])


@pytest.mark.parametrize(
    ("eyes", "step", "gain"),
    [
        (np.array([[5.0, 0, 0]] * 40) + np.eye(3)[np.arange(40) % 3], STEP, 5),  # on one side
        (
            np.random.default_rng(1).normal(0, 6, (60, 3)),
            STEP,
            0.9,
        ),  # all around there is nothing to gain
        (np.array([[5.0, 0, 0]]), ALONE, 1),
        (np.zeros((0, 3)), ALONE, 1),
    ],
)
def test_the_cameras_see_nearly_the_colours_that_they_saw(eyes, step, gain):
    p = gaussian_parameters(300)
    p["shN"] = (0.3 * p["shN"]).clip(-1, 1)
    p["means"] *= np.float32(0.3)
    found = rounded_light(p, eyes)
    steps = found["shN"] / np.float32(step)
    assert np.abs(steps - np.rint(steps)).max() < 1e-4 and np.abs(found["shN"]).max() <= 1
    for degree, n_rest in enumerate((0, 3, 8)):
        assert not found["shN"][p["degrees"] == degree, n_rest:].any()
    alone = p | {"shN": (step * np.rint(p["shN"] / step)).astype(np.float32)}
    if gain == 1:
        assert np.array_equal(found["sh0"], p["sh0"])
        np.testing.assert_allclose(found["shN"], alone["shN"], atol=1e-6)
        return
    wanted = seen(p, eyes)
    errors = [np.sqrt(np.mean((seen(of, eyes) - wanted) ** 2)) for of in (alone, found)]
    assert errors[0] > gain * errors[1]
