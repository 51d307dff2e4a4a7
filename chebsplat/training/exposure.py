"""Exposure and white balance: an affine map of colours for each training view, learned with the scene.

The scene's own colours are those of the mean view: maps belong to photos, and nothing that is exported has one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.training.row_adam import RowAdam

CELL, MOST_POINTS, LEAST_POINTS = 8, 4000, 30  # of `exposure_spread`: pixels; points that are looked at, and of a view


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


def exposure_spread(
    images: Iterable[np.ndarray],
    Ks: np.ndarray,
    cam_from_world: np.ndarray,
    points: np.ndarray,
    seen: np.ndarray | None = None,
) -> float:
    """How much photos of the same points differ in colour: the standard deviation over views of its logarithm.

    Args: images: u8 [H, W, 3] of V views; Ks [V, 3, 3] pixels; cam_from_world [V, 4, 4]; points [N, 3]; seen: bool
      [N, V], or None: by all views that have the point within their frame.
    Choices: of a view the median over points, each against its own median over views, so that walls in between and
      highlights count little; colours are means over 8 × 8 pixels. 0 where no three views see enough of the same.
    """
    chosen = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).astype(int)
    logs = np.full((len(chosen), len(Ks), 3), np.nan)
    for view, image in enumerate(images):
        height, width = image.shape[:2]
        side = min(CELL, height, width)
        camera = points[chosen] @ cam_from_world[view, :3, :3].T + cam_from_world[view, :3, 3]
        front = camera[:, 2] > 1e-3
        u, v = ((camera / np.where(front, camera[:, 2], 1)[:, None]) @ Ks[view].T)[:, :2].T
        inside = front & (u >= 0) & (u < width // side * side) & (v >= 0) & (v < height // side * side)
        if seen is not None:
            inside &= seen[chosen, view]
        cells = image[: height // side * side, : width // side * side].astype(np.float64)
        cells = cells.reshape(height // side, side, width // side, side, 3).mean((1, 3))
        logs[inside, view] = np.log(cells[(v[inside] / side).astype(int), (u[inside] / side).astype(int)] + 4)
    logs = logs[np.isfinite(logs[..., 0]).sum(1) >= 3]
    enough = np.isfinite(logs[..., 0]).sum(0) >= LEAST_POINTS
    if enough.sum() < 3:
        return 0.0
    by_view = np.nanmedian(logs[:, enough] - np.nanmedian(logs, axis=1, keepdims=True), axis=0)
    return float(by_view.std(0).mean())
