"""What a training learns of each photo beside the scene: the exposure it was taken with, and where exactly from."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from chebsplat.training.exposure import Exposure
from chebsplat.training.poses import Poses
from chebsplat.views import View, Views


class CameraModels(NamedTuple):
    """Models of the training views; None where photos are alike, or poses exact: then every step is as without."""

    exposure: Exposure | None = None
    poses: Poses | None = None

    def camera(self, views: Views, view: int, factor: int, learning: bool = True) -> View:
        """A view's camera at 1/factor of its resolution, at its pose as it is now."""
        camera = views.camera(view, factor)
        return camera if self.poses is None else self.poses.camera(camera, view, learning)

    def taken(self, colors: Tensor, view: int) -> Tensor:
        """Rendered colours [H, W, 3] as the view's photo shows them."""
        return colors if self.exposure is None else self.exposure.apply(colors, view)

    def losses(self) -> dict[str, Tensor]:
        """Penalties of the view that was last rendered, by name."""
        return {} if self.exposure is None else {"exposure": self.exposure.penalty()}

    def step(self, view: int, share: float) -> None:
        """Follow the gradients of the view that was last rendered, at this share of the training's budget."""
        for model in self:
            if model is not None:
                model.step(view, share)

    def state_dict(self) -> dict[str, Any]:
        return {name: model.state_dict() for name, model in self._asdict().items() if model is not None}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in state.items():
            getattr(self, name).load_state_dict(part)
