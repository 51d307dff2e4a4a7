"""Adam for a table of which a step sees one row."""

from __future__ import annotations

import torch
from torch import Tensor


class RowAdam:
    """Every row of a table [V, K] has its own moments and its own count of steps.

    Args: decays: of the mean gradient, and of the mean square; joint: one mean square for a row, so that its steps keep
      the gradient's direction and are about `rate` long at first, where by default each value's are.
    Choices: Adam over the whole table would move each view on by what it remembers while others are trained, and its
      first steps would be √V too long.
    """

    def __init__(self, n_rows: int, size: int, decays: tuple[float, float] = (0.9, 0.99), joint: bool = False):
        self.decays, self.joint = decays, joint
        self.moments = torch.zeros(2, n_rows, size, dtype=torch.float64)
        self.counts = torch.zeros(n_rows, dtype=torch.int64)

    def change(self, row: int, gradient: Tensor, rate: float) -> Tensor:
        """What the row's values [K] change by, float64; a gradient that is not finite changes nothing."""
        gradient = gradient.detach().double()
        if not torch.isfinite(gradient).all():
            return torch.zeros_like(gradient)
        self.counts[row] += 1
        mean, square = self.moments[:, row]
        mean.lerp_(gradient, 1 - self.decays[0])
        square.lerp_((gradient**2).sum().expand_as(square) if self.joint else gradient**2, 1 - self.decays[1])
        count = int(self.counts[row])
        corrected = [moment / (1 - decay**count) for moment, decay in zip((mean, square), self.decays, strict=True)]
        change: Tensor = -rate * corrected[0] / (corrected[1].sqrt() + 1e-15)
        return change

    def state_dict(self) -> dict[str, Tensor]:
        return {"moments": self.moments, "counts": self.counts}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.moments, self.counts = state["moments"], state["counts"]
