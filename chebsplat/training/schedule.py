"""The optimizer's rates, and what is due when in a training, as a function of the share of its budget that is spent."""

from __future__ import annotations

import torch

from chebsplat.settings import MOST_STEPS, TrainSection
from chebsplat.splats.sh import MAX_DEGREE
from chebsplat.training.model import SceneModel
from chebsplat.training.prune import SemanticGate

TRAVEL, MOST = 10.0, 5e-2  # a rate that is not given: less than TRAVEL over all steps does not arrive
LR_OPACITIES = 5e-2  # of opacities before the sigmoid, 3DGS's
LR_MODULES, LR_GATES = 3e-3, 1e-2  # of the encoder, and of the printed gates' weights
FASTER = {"means": 0.01, "features": 0.01, "modules": 0.01}  # what a rate has fallen to at the end; 0.1 elsewhere


PUBLISHED = 30_000  # steps that 3DGS's rates are for
FEWEST = 1000  # steps below which rates rise no further, and that a training has unless it is told


def n_steps(settings: TrainSection, n_pixels: int) -> int:
    """Steps of a training on photos of `n_pixels` pixels in all.

    Choices: 280 a megapixel, in hundreds, from FEWEST to MOST_STEPS, by held-out training views (docs/results.md, "How
      many steps"): the more there is to see, the longer a training gains. 70 photos of 320×240 pixels are best served
      by 1500 steps, and with 3000 lose 0.5 dB again; 43 of 360×640 gain until 3000.
    """
    by_photos = 100 * round(2.8 * n_pixels / 1e6)
    return min(max(by_photos, FEWEST), MOST_STEPS) if settings.steps is None else settings.steps


def by_steps(given: float | None, published: float, power: float, steps: int) -> float:
    """A rate that is not given: the published one times (30,000 / steps)^power, since fewer steps must each go further.

    Choices: powers from 1000-step trainings of office0 and fox, where means 8 times, scales and rotations 3 times and
      colours 4 times as fast were best on held-out training views; 1 from 30,000 steps on.
    """
    return published * max(PUBLISHED / max(steps, FEWEST), 1) ** power if given is None else given


def feature_every(settings: TrainSection, n_views: int) -> int:
    """Steps from one that renders and teaches features to the next.

    Choices: one step in four teaches them as well as every one, for less than half of what they add to a step's time;
      where views are few, features hold the Gaussians in place, too (ten views: 24.3 dB, and 23.1 in one of four).
    """
    return min(max(n_views // 10, 1), 4) if settings.feature_every is None else settings.feature_every


def starts_lifted(settings: TrainSection, n_views: int) -> bool:
    """Whether features start as what the views say of the Gaussians, not at nothing.

    Choices: where views are few, features that are there from the first step pull Gaussians towards what single views
      show (six, ten, twenty views of one room: 3.6, 3.6 and 1.0 dB less; seventy: none).
    """
    return n_views >= 40 if settings.feature_start is None else settings.feature_start == "lifted"


def rates(settings: TrainSection) -> dict[str, float]:
    """Learning rate of each raw parameter before any schedule; that of `means` is relative to the scene's extent."""
    features, steps = settings.lr_features, settings.steps or MOST_STEPS
    taught = max(steps // (settings.feature_every or 1), 1)
    sh = by_steps(settings.lr_sh, 1.25e-4, 0.41, steps)
    return {
        "means": by_steps(settings.lr_means, 1.6e-4, 0.61, steps),
        "log_scales": by_steps(settings.lr_scales, 5e-3, 0.52, steps),
        "quats": by_steps(settings.lr_quats, 1e-3, 0.52, steps),
        "logit_opacities": LR_OPACITIES,
        "sh0": by_steps(settings.lr_sh0, 2.5e-3, 0.41, steps),
        "sh1": sh,
        "sh2": sh,
        "sh3": sh,
        "features": min(TRAVEL / taught, MOST) if features is None else features,
        "prune_logits": settings.lr_masks,
        "sh_logits": settings.lr_sh_masks,
    }


def adam(model: SceneModel, settings: TrainSection, extent: float) -> torch.optim.Adam:
    """A group for each raw parameter of the model and one for its modules, with their `rate` before any schedule.

    Args: settings: the train section; extent: scene units, scales the means' rate.
    """
    groups = []
    base_rates = rates(settings)
    for name, value in model.raw.items():
        rate = base_rates[name] * (extent if name == "means" else 1)
        groups.append({"params": [value], "rate": rate, "name": name})
    printed = {part for part in (model.semantic_gate, model.band_network) if not isinstance(part, SemanticGate)}
    for name, rate, own in (("modules", LR_MODULES, False), ("gates", LR_GATES, True)):
        weights = [p for module in model.modules.values() if (module in printed) == own for p in module.parameters()]
        if weights:
            groups.append({"params": weights, "rate": rate, "name": name})
    return torch.optim.Adam(groups, eps=1e-15, fused=True)


class Schedule:
    """Of a train section whose steps are known. A budget is a number of steps, or seconds of training: then the pace is
    the machine's, and two runs are not the same.
    """

    def __init__(self, settings: TrainSection):
        self.settings, self.steps = settings, settings.steps or MOST_STEPS
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
        """How many steps there will be, after `step` of them in `seconds`."""
        if self.seconds is None:
            return self.steps
        return max(step, round(step * self.seconds / seconds)) if seconds > 0 else step + 1

    def rate(self, name: str, share: float, steps: int) -> float:
        """What a group's learning rate is multiplied by, in a training that will have about so many steps.

        Choices: pruning masks go no farther in a long training than in one of MOST_STEPS. A penalty that Adam turns
          into steps of one size closes them for as long as it lasts: 8000 steps left a room 4,832 of 40,000 Gaussians.
        """
        slower = min(MOST_STEPS / max(steps, 1), 1.0) if name == "prune_logits" else 1.0
        return float(slower * FASTER.get(name, 0.1) ** share)

    def degree(self, share: float) -> int:
        """SH bands in use: one more every tenth of the training."""
        return min(int(share * 10 + 1e-9), self.settings.sh_degree, MAX_DEGREE)

    def factor(self, share: float) -> int:
        """What images are reduced by."""
        return 2 if share <= self.settings.coarse_until else 1

    def grown(self, share: float) -> int:
        """How many times Gaussians were to be added until now."""
        return sum(share >= at for at in self.growth)

    def reset(self, share: float) -> int:
        """How many times opacities were to fall until now."""
        return sum(share >= at for at in self.resets)

    def encodes(self, share: float) -> bool:
        """Are regions encoded?"""
        return share >= self.settings.encode_from

    def prunes(self, share: float) -> bool:
        """Are Gaussians pruned?"""
        return share >= self.settings.prune_from

    def has_grown(self, share: float) -> bool:
        """Is growth over?"""
        return share >= self.settings.densify_until

    def freezes_bands(self, share: float) -> bool:
        """Do SH bands stay as they are?"""
        return share >= self.settings.sh_freeze
