"""A training keeps rows, moments and bands together, whatever comes and goes."""

import chebsplat  # noqa: F401  # isort: skip
import numpy as np
import pytest
import torch
from training import trainer

from chebsplat.errors import ConfigError
from chebsplat.stages import config


def test_closed_bands_leave_parameters_and_moments_and_the_picture_stays():
    made = trainer(sh_freeze=0.9, steps=20, densify="off", prune_from=0.0)
    steps = made.steps()
    for _ in range(17):
        next(steps)
    raw = made.model.raw
    with torch.no_grad():
        raw["sh_logits"].copy_(torch.randn(raw["sh_logits"].shape, generator=torch.Generator().manual_seed(3)) * 6)
    degrees = (made.model.sh_mask(torch.arange(len(made.model))) > 0.5).sum(-1)
    moments = {name: dict(made.optimizer.state[value]) for name, value in raw.items()}
    before, means = made.model.render(made.views.camera(0, 1), 3)[0].rgb, raw["means"].detach().clone()
    made._freeze_bands()
    after = made.model.render(made.views.camera(0, 1), 3)[0].rgb
    assert (after - before).abs().max() < 2e-6  # the order of equal depths may change
    order = torch.argsort(degrees, descending=True, stable=True)
    assert torch.equal(raw["means"], means[order])
    for name, value in raw.items():
        assert len(value) == (int((degrees >= int(name[2])).sum()) if name in ("sh1", "sh2", "sh3") else len(order))
        state = made.optimizer.state[value]
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key], moments[name][key][order[: len(value)]])
    assert "sh_logits" not in raw and "sh_logits" not in {g["name"] for g in made.optimizer.param_groups}
    assert 0 < len(raw["sh3"]) < len(raw["sh2"]) < len(raw["sh1"]) < len(order)
    for _ in steps:  # trains on
        pass
    parameters = made.finish()
    assert np.array_equal(parameters["degrees"], degrees[order].numpy())
    absent = np.arange(1, 16) >= (parameters["degrees"][:, None] + 1) ** 2
    assert not parameters["shN"][absent].any()


def test_a_band_that_nobody_keeps_is_gone():
    made = trainer(densify="off")
    with torch.no_grad():
        made.model.raw["sh_logits"].copy_(torch.tensor([8.0, -8.0, 8.0]).expand_as(made.model.raw["sh_logits"]))
    made._freeze_bands()
    assert {"sh2", "sh3"}.isdisjoint(made.model.raw) and len(made.model.raw["sh1"]) == len(made.model)
    assert {"sh2", "sh3"}.isdisjoint(group["name"] for group in made.optimizer.param_groups)


def test_gaussians_removed_after_the_freeze_take_their_bands_along():
    made = trainer(densify="off", prune=False)
    raw = made.model.raw
    with torch.no_grad():
        raw["sh_logits"].copy_(torch.randn(raw["sh_logits"].shape) * 6)
        for band in (1, 2, 3):
            raw[f"sh{band}"].copy_(torch.randn(raw[f"sh{band}"].shape))
    made._freeze_bands()
    before = made.finish()
    with torch.no_grad():
        raw["logit_opacities"][::3] = -20.0
    made._remove(1)
    after = made.finish()
    kept = np.arange(len(before["means"])) % 3 != 0
    for name in ("means", "sh0", "shN", "degrees"):
        assert np.array_equal(after[name], before[name][kept]), name


def test_growth_after_the_freeze_is_refused():
    with pytest.raises(ConfigError, match="densify_until"):
        config.build({"train": {"densify_until": 0.9}}, "test")
