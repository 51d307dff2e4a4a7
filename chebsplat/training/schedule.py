"""The optimizer's rates and the events of a training, by the share of its budget that is spent."""

from __future__ import annotations

from typing import Any

import torch

from chebsplat.settings import MOST_STEPS, TrainSection
from chebsplat.splats.sh import MAX_DEGREE
from chebsplat.training.adam import adam
from chebsplat.training.model import SceneModel

STEP_SIDE = 640  # pixels of the longer side of what a step looks at, at least
LR_OPACITIES = 5e-2  # of opacities before the sigmoid, 3DGS's
LR_MODULES = 3e-3  # of the printed modules
# what a rate has fallen to at the end; 0.1 elsewhere
FASTER = {"means": 0.01, "features": 0.01, "modules": 0.01}


def require_resolved(settings: TrainSection) -> None:
    """Raises ValueError on an open setting (`stages.training.defaults.resolved` decides them)."""
    left = [name for name, value in settings if value is None and name not in ("seconds", "start")]
    if left:
        raise ValueError(f"train.{left[0]} is open: pass a section that is resolved")


def rates(settings: TrainSection) -> dict[str, float]:
    """Learning rate of each raw parameter before any schedule; of `means`: in scene extents."""
    by_name = {
        "means": settings.lr_means,
        "log_scales": settings.lr_scales,
        "quats": settings.lr_quats,
        "logit_opacities": LR_OPACITIES,
        "sh0": settings.lr_sh0,
        "sh1": settings.lr_sh,
        "sh2": settings.lr_sh,
        "sh3": settings.lr_sh,
        "features": settings.lr_features,
        "prune_logits": settings.lr_masks,
        "sh_logits": settings.lr_sh_masks,
    }
    return {name: rate for name, rate in by_name.items() if rate is not None}


def optimizer_of(model: SceneModel, settings: TrainSection, extent: float) -> torch.optim.Adam:
    """A group for each raw parameter of the model, one for SH bands 1 to 3 together, which have one
    rate (each group is two launches on a GPU), and one for its modules, with their `rate` before
    any schedule.

    Args: settings: the train section; extent: scene units, scales the means' rate.
    """
    groups: dict[str, dict[str, Any]] = {}
    base_rates = rates(settings)
    for name, value in model.raw.items():
        rate = base_rates[name] * (extent if name == "means" else 1)
        group = "sh" if name in ("sh1", "sh2", "sh3") else name
        groups.setdefault(group, {"params": [], "rate": rate, "name": group})["params"].append(
            value
        )
    if weights := [p for module in model.modules.values() for p in module.parameters()]:
        groups["modules"] = {"params": weights, "rate": LR_MODULES, "name": "modules"}
    return adam(list(groups.values()))


class Schedule:
    """Of a resolved train section, and photos whose longer side has `side` pixels.

    A budget is a number of steps, or seconds of training: then the pace is the machine's, and no
    two runs are the same.
    """

    def __init__(self, settings: TrainSection, side: int = STEP_SIDE):
        require_resolved(settings)
        assert settings.steps is not None
        self.settings, self.steps = settings, settings.steps
        self.reduction = max(int(side / STEP_SIDE + 0.1), 1)
        self.seconds: float | None = settings.seconds
        self.growth = [] if settings.densify == "off" else self._while_growing(settings.n_densify)
        self.resets = self._while_growing(settings.opacity_resets)

    def _while_growing(self, n: int) -> list[float]:
        """Shares of n moments, evenly within growth."""
        first, last = self.settings.densify_from, self.settings.densify_until
        return [first + (last - first) * (k + 1) / (n + 1) for k in range(n)]

    def share(self, step: int, seconds: float) -> float:
        """Part of the budget, in [0, 1], that is spent once `step` is done."""
        if self.seconds is None:
            return step / self.steps
        return min(seconds / self.seconds, 1.0)

    def last_step(self, step: int, seconds: float) -> int:
        """Number of steps of the whole training, after `step` of them in `seconds`."""
        if self.seconds is None:
            return self.steps
        return max(step, round(step * self.seconds / seconds)) if seconds > 0 else step + 1

    def rate(self, name: str, share: float, steps: int) -> float:
        """Factor of a group's learning rate, in a training of about so many steps.

        Choices: pruning masks go no farther in a long training than in one of MOST_STEPS. A penalty
          that Adam turns into steps of one size closes them for as long as it lasts: 8000 steps
          left a room 4,832 of 40,000 Gaussians. While steps look at windows, all are slower by the
          photos' reduction: a Gaussian is in few of them, and between them Adam's mean square of
          gradients falls, and each step would go that much farther.
        """
        slower = min(MOST_STEPS / max(steps, 1), 1.0) if name == "prune_logits" else 1.0
        slower /= self.reduction if self.in_full(share) else 1
        return float(slower * FASTER.get(name, 0.1) ** share)

    def degree(self, share: float) -> int:
        """SH bands in use: one more every tenth of the training."""
        return min(int(share * 10 + 1e-9), self.settings.sh_degree, MAX_DEGREE)

    def factor(self, share: float) -> int:
        """Reduction of a whole photo that a step looks at."""
        return self.reduction * (2 if share <= self.settings.coarse_until else 1)

    def in_full(self, share: float) -> bool:
        """True where steps look at windows of unreduced photos; never if whole ones are small."""
        return self.reduction > 1 and share > self.settings.fine_from

    def grown(self, share: float) -> int:
        """Number of times that Gaussians were to be added until now."""
        return sum(share >= at for at in self.growth)

    def reset(self, share: float) -> int:
        """Number of times that opacities were to fall until now."""
        return sum(share >= at for at in self.resets)

    def prunes(self, share: float) -> bool:
        """True once Gaussians are pruned."""
        return share >= self.settings.prune_from

    def has_grown(self, share: float) -> bool:
        """True once growth is over."""
        return share >= self.settings.densify_until

    def freezes_bands(self, share: float) -> bool:
        """True once SH bands stay as they are; never in training where `sh_freeze` is 1."""
        return self.settings.sh_freeze < 1 and share >= self.settings.sh_freeze
