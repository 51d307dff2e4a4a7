"""Exposure and white balance: an affine map of colours for each training view, learned with the scene.

The scene's own colours are those of the mean view: maps belong to photos, and nothing that is exported has one.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from chebsplat.training.row_adam import RowAdam


class Exposure:
    """colour' = (I + A_v) colour + b_v of V views; [A_v | b_v] [3, 4] starts at zero, and so stays its mean over views.

    Args: rate: of Adam, in colours from 0 to 1, at the start; weight: of the pull towards the identity; device: of the
      colours.
    Choices: the mean over views is held at the identity, since otherwise all maps and the scene's colours could drift
      together, unseen by any photo.
    """

    def __init__(self, n_views: int, rate: float, weight: float, device: str | torch.device = "cpu"):
        self.rate, self.weight = rate, weight
        self.maps = torch.zeros(n_views, 3, 4, dtype=torch.float64, device=device)
        self.optimizer = RowAdam(n_views, 12, device=device)
        self.leaf = torch.zeros(3, 4, device=device)

    def apply(self, colors: Tensor, view: int) -> Tensor:
        """Colours [H, W, 3] as this view's camera would have taken them; `step` follows the gradient of the last."""
        self.leaf = self.maps[view].float().requires_grad_()
        return colors @ (torch.eye(3, device=self.leaf.device) + self.leaf[:, :3]).T + self.leaf[:, 3]

    def penalty(self) -> Tensor:
        """The pull of the map that was last applied towards the identity."""
        return self.weight * self.leaf.square().sum()

    def step(self, view: int, share: float) -> None:
        """Follow the gradient of the view that was last rendered."""
        if self.leaf.grad is None:
            return
        self.maps[view] += self.optimizer.change(view, self.leaf.grad.flatten(), self.rate * 0.1**share).view(3, 4)
        self.maps -= self.maps.mean(0)

    def state_dict(self) -> dict[str, Any]:
        return {"maps": self.maps, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.maps = state["maps"]
        self.optimizer.load_state_dict(state["optimizer"])
