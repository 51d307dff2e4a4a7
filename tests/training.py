"""A tiny training: 300 Gaussians on a sphere, four photos of 48 x 40, eight feature channels."""

import torch

from chebsplat.gaussians import initial_gaussians, local_shape
from chebsplat.model import SceneModel
from chebsplat.stages.config import Config
from chebsplat.trainer import Trainer
from chebsplat.views import Views

HEIGHT, WIDTH = 40, 48


def views(n_views=4, n_channels=8):
    g = torch.Generator().manual_seed(1)
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    angles = torch.linspace(0, 1.2, n_views)
    poses = torch.eye(4).repeat(n_views, 1, 1)
    poses[:, 0, 0], poses[:, 0, 2] = angles.cos(), angles.sin()
    poses[:, 2, 0], poses[:, 2, 2] = -angles.sin(), angles.cos()
    poses[:, 2, 3] = 4
    images = (torch.rand(n_views, HEIGHT, WIDTH, 3, generator=g) * 255).byte()
    features = torch.nn.functional.normalize(torch.randn(n_views, 10, 12, n_channels, generator=g), dim=-1)
    return Views(
        [f"view{k}" for k in range(n_views)], images, K.repeat(n_views, 1, 1), poses, None, lambda k: features[k]
    )


def trainer(n=300, seen=None, **settings):
    """A trainer of `n` Gaussians whose first refresh is done; `settings` change the train section."""
    g = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1).numpy()
    colors = (torch.rand(n, 3, generator=g) * 255).byte().numpy()
    raw = initial_gaussians(means, colors, local_shape(means, 8)[0], opacity=0.5)
    small = {"steps": 20, "min_gaussians": 8, "max_gaussians": n + 100, "n_densify": 2, "width": 16}
    config = Config.model_validate({"train": small | settings, "describe": {"n_regions": 24, "region_size": 16}})
    train, describe = config.train.model_dump(), config.describe.model_dump()
    seen = views() if seen is None else seen
    torch.manual_seed(train["seed"])
    model = SceneModel(raw, describe, train, 8 if seen.features is not None else None)
    made = Trainer(model, seen, train, describe, 1.0, {})
    made.refresh()
    return made
