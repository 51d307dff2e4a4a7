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

    def __init__(
        self,
        n_rows: int,
        size: int,
        decays: tuple[float, float] = (0.9, 0.99),
        joint: bool = False,
        device: str | torch.device = "cpu",
    ):
        self.decays, self.joint = decays, joint
        self.moments = torch.zeros(2, n_rows, size, dtype=torch.float64, device=device)
        self.counts = torch.zeros(n_rows, dtype=torch.int64, device=device)

    def change(self, row: int, gradient: Tensor, rate: float) -> Tensor:
        """What the row's values [K] change by, float64; a gradient that is not finite changes nothing."""
        gradient = gradient.detach().double()
        usable = torch.isfinite(gradient).all()  # not asked for as a truth: on a GPU, that would wait
        self.counts[row] += usable
        count, held = self.counts[row].double(), self.moments[:, row]
        size = (gradient**2).sum().expand_as(gradient) if self.joint else gradient**2
        moments = [
            held[k].lerp(torch.where(usable, value, held[k]), 1 - self.decays[k])
            for k, value in enumerate((gradient, size))
        ]
        self.moments[:, row] = torch.stack(moments)
        mean, square = (moment / (1 - decay**count) for moment, decay in zip(moments, self.decays, strict=True))
        change = -rate * mean / (square.sqrt() + 1e-15)
        return torch.where(usable, change, 0)

    def state_dict(self) -> dict[str, Tensor]:
        return {"moments": self.moments, "counts": self.counts}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.moments, self.counts = state["moments"], state["counts"]
