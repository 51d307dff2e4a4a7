"""Trainings that ought to break: each ends with finite Gaussians, or stops with step and cause.

The error is the share of values that are not finite in what would be published, 1 where the
training stopped without naming its step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.stability.case import Outcome, case
from chebsplat.errors import DataFailure
from chebsplat.splats.gaussians import initial_gaussians, local_shape
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.training.defaults import Evidence, resolved
from chebsplat.training.model import SceneModel
from chebsplat.training.printed import PrintedScene
from chebsplat.training.trainer import Trainer
from chebsplat.views import Views

HEIGHT, WIDTH, CHANNELS = 40, 48, 8


def four_views() -> Views:
    """Noisy photos, 48 x 40, in an arc about the origin; unit features at a quarter of that."""
    g = torch.Generator().manual_seed(1)
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    angles, poses = torch.linspace(0, 1.2, 4), torch.eye(4).repeat(4, 1, 1)
    poses[:, 0, 0], poses[:, 0, 2] = angles.cos(), angles.sin()
    poses[:, 2, 0], poses[:, 2, 2] = -angles.sin(), angles.cos()
    poses[:, 2, 3] = 4
    images = (torch.rand(4, HEIGHT, WIDTH, 3, generator=g) * 255).byte()
    features = torch.nn.functional.normalize(torch.randn(4, 10, 12, CHANNELS, generator=g), dim=-1)
    return Views(
        [f"view{k}" for k in range(4)],
        images,
        K.repeat(4, 1, 1),
        poses,
        None,
        lambda k: features[k],
    )


def sphere(n: int) -> np.ndarray:
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(points, dim=-1).numpy()


def tiny_trainer(
    means: np.ndarray | None = None, views: Views | None = None, **settings: Any
) -> Trainer:
    """A trainer of few Gaussians, by default 300 on a unit sphere; settings: of training."""
    means = sphere(300) if means is None else means
    colors = (
        (torch.rand(len(means), 3, generator=torch.Generator().manual_seed(2)) * 255).byte().numpy()
    )
    shapes = (
        local_shape(means, 8)[0] if len(means) > 1 else np.eye(3, dtype=np.float32)[None] * 0.01
    )
    small = {
        "steps": 20,
        "min_gaussians": 8,
        "max_gaussians": len(means) + 100,
        "n_densify": 2,
    }
    config = Config.model_validate(
        {"train": small | settings, "describe": {"n_regions": 24, "region_size": 16}}
    )
    torch.manual_seed(config.train.seed)
    kind = PrintedScene if config.train.method == "printed" else SceneModel
    model = kind(
        initial_gaussians(means, colors, shapes, opacity=0.5),
        config.describe,
        config.train,
        CHANNELS,
    )
    views = four_views() if views is None else views
    n_views, height, width = views.images.shape[:3]
    train = resolved(config.train, Evidence(n_views, n_views * height * width))
    return Trainer(model, views, train, 1.0)


def _with_views(**changes: Callable[[Views], Any]) -> Trainer:
    views = four_views()
    changed = replace(views, **{name: change(views) for name, change in changes.items()})
    return tiny_trainer(views=changed)


def _corrupt(value: float) -> Callable[[Views], Any]:
    """Features of which one view's are `value`."""

    def change(views: Views) -> Any:
        of = views.features
        assert of is not None
        return lambda k: torch.full((10, 12, CHANNELS), value) if k == 1 else of(k)

    return change


def _multiplied(factor: float) -> Callable[[Views], Any]:
    return lambda views: lambda k: factor * views.features(k)  # type: ignore[misc]


def _black(views: Views) -> torch.Tensor:
    images = views.images.clone()
    images[1] = 0
    return images


def _away(views: Views) -> torch.Tensor:
    poses = views.viewmats.clone()
    poses[1] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ poses[1]
    return poses


def _hidden(views: Views) -> torch.Tensor:
    shape = views.images.shape[:3]
    return torch.arange(4)[:, None, None].ne(1).expand(shape)  # type: ignore[arg-type]


def _lost(views: Views) -> torch.Tensor:
    poses = views.viewmats.clone()
    poses[1, 0, 3] = torch.nan
    return poses


def _raw(**changes: Callable[[torch.Tensor], Any]) -> Trainer:
    trainer = tiny_trainer()
    with torch.no_grad():
        for name, change in changes.items():
            change(trainer.model.raw[name])
    trainer.refresh()
    return trainer


def _at_the_camera(means: torch.Tensor) -> None:
    views = four_views()
    means[0] = -views.viewmats[0, :3, :3].T @ views.viewmats[0, :3, 3]


def _rates(factor: float) -> Trainer:
    trainer = tiny_trainer()
    for group in trainer.optimizer.param_groups:
        group["rate"] *= factor
    return trainer


def _flat() -> np.ndarray:
    return sphere(300) * np.array([1, 1, 0], np.float32)


SCENES: dict[str, Callable[[], Trainer]] = {
    "all masks closing": lambda: tiny_trainer(weight_mask=1e4, lr_masks=10.0, prune_from=0.1),
    "all bands closing": lambda: tiny_trainer(weight_sh=1e4, lr_sh_masks=10.0),
    "one Gaussian": lambda: tiny_trainer(sphere(1), min_gaussians=1),
    "two coincident Gaussians": lambda: tiny_trainer(np.zeros((2, 3), np.float32), min_gaussians=1),
    "one plane": lambda: tiny_trainer(_flat()),
    "a line": lambda: tiny_trainer(_flat() * np.array([1, 0, 0], np.float32)),
    "a camera inside a Gaussian": lambda: _raw(
        means=_at_the_camera, log_scales=lambda v: v[0].fill_(1.0)
    ),
    "a Gaussian of scale 1e30": lambda: _raw(log_scales=lambda v: v[0].fill_(69.0)),
    "needles of 1e-20": lambda: _raw(log_scales=lambda v: v[:, 0].fill_(-46.0)),
    "needles of 1e+03": lambda: _raw(log_scales=lambda v: v[:, 0].fill_(7.0)),
    "near-flat Gaussians": lambda: _raw(log_scales=lambda v: v[:, 2].fill_(-30.0)),
    "quaternions of 1e-30": lambda: _raw(quats=lambda v: v.mul_(1e-30)),
    "SH of 1e+04": lambda: _raw(
        sh0=lambda v: v.mul_(1e4), sh1=lambda v: v.fill_(1e4), sh3=lambda v: v.fill_(-1e4)
    ),
    "all on one pixel": lambda: _raw(
        means=lambda v: v.copy_(v[:1].expand_as(v)), log_scales=lambda v: v.fill_(-7.0)
    ),
    "quaternions of 0": lambda: _raw(quats=lambda v: v[::5].zero_()),
    "opacity logits of ±1e4": lambda: _raw(
        logit_opacities=lambda v: (v[::2].fill_(1e4), v[1::2].fill_(-1e4))
    ),
    "a NaN colour": lambda: _raw(sh0=lambda v: v[3].fill_(torch.nan)),
    "NaN features of one Gaussian": lambda: _raw(features=lambda v: v[3].fill_(torch.nan)),
    "teacher features of norm 1e6": lambda: _with_views(features=_multiplied(1e6)),
    "teacher features of 0": lambda: _with_views(features=_multiplied(0.0)),
    "one view's features NaN": lambda: _with_views(features=_corrupt(float("nan"))),
    "one view's features 1e30": lambda: _with_views(features=_corrupt(1e30)),
    "one view black": lambda: _with_views(images=_black),
    "one view looks away": lambda: _with_views(viewmats=_away),
    "nothing of one view counts": lambda: _with_views(masks=_hidden),
    "one view's pose NaN": lambda: _with_views(viewmats=_lost),
    "rates 10 times too high": lambda: _rates(10),
    "rates 1000 times too high": lambda: _rates(1000),
    "scene in units of 1e6": lambda: tiny_trainer(1e6 * sphere(300)),
}


@case("{name}", name=SCENES)
def training(name: str) -> Outcome:
    trainer = SCENES[name]()
    try:
        for _ in trainer.steps():
            pass
        parameters = trainer.finish()
    except DataFailure as failure:
        return Outcome(float(not str(failure).startswith("step ")), 0.0)
    values = [*np.concatenate([value.ravel().astype(np.float64) for value in parameters.values()])]
    return Outcome(
        float(1 - np.isfinite([*values, trainer.held_in_psnr(list(range(4)))]).mean()), 0.0
    )
