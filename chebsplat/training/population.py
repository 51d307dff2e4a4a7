"""Population of Gaussians: growth, removal and freeze of SH bands, with the optimizer's moments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from chebsplat.settings import TrainSection
from chebsplat.training import densify, optimizer_rows, prune, sh_prune
from chebsplat.training.model import Rendered, SceneModel
from chebsplat.training.printed import PrintedScene

FAINT = 0.005  # opacity below which a Gaussian is removed
TINY = 1e-30  # scene units: a bound for what lies in a camera
DIMMED = 0.01  # what a reset lowers opacities to


class Population:
    """The Gaussians of a model under an optimizer whose groups are named for the raw parameters.

    places: of the training cameras, scene units [V, 3]; those that are not finite bound nothing.
    `n_grown` and `n_reset` count the times that some were added and that all were dimmed, the
    others Gaussians: `n_broken` those whose values a step made non-finite. The caller refreshes the
    regions after any change.
    """

    def __init__(
        self, model: SceneModel, settings: TrainSection, extent: float, places: np.ndarray
    ):
        self.model, self.settings, self.extent = model, settings, extent
        self.cameras = cKDTree(places[np.isfinite(places).all(1)])
        self.n_grown = self.n_reset = self.n_added = self.n_removed = self.n_broken = 0
        self.clear_gradients()

    def state_dict(self) -> dict[str, Any]:
        """Counts, bounds, gradients since growth: tensors, not copied, and plain values."""
        return {
            "counts": [self.n_grown, self.n_reset, self.n_added, self.n_removed, self.n_broken],
            "tensors": [self.gradient_sum, self.gradient_count, self.log_bound],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on as the population whose `state_dict()` this is."""
        self.n_grown, self.n_reset, self.n_added, self.n_removed, self.n_broken = state["counts"]
        self.gradient_sum, self.gradient_count, self.log_bound = state["tensors"]

    def clear_gradients(self) -> None:
        """Begin to gather gradients anew, of as many Gaussians as there are."""
        means = self.model.raw["means"]
        self.gradient_sum, self.gradient_count = (means.new_zeros(len(means)) for _ in range(2))

    def note_gradients(self, rendered: Rendered) -> None:
        """Add the length of the loss' gradient to 2D means, in half image widths as in gsplat."""
        if self.settings.region_gradient == "features" and rendered.auxiliary.fused is not None:
            gradient = rendered.auxiliary.fused.grad
            if gradient is not None:
                self.gradient_sum.index_add_(0, rendered.index, gradient.norm(dim=-1))
                self.gradient_count[rendered.index] += 1
            return
        gradient = rendered.meta["means2d"].grad
        if gradient is None:
            return
        height, width = rendered.rgb.shape[:2]
        length = torch.hypot(gradient[0, :, 0] * (0.5 * width), gradient[0, :, 1] * (0.5 * height))
        visible = rendered.meta["radii"][0] > 0
        length = torch.where(visible, length, 0)  # nothing waits for a count
        if rendered.index is None:
            self.gradient_sum += length
            self.gradient_count += visible
        else:
            self.gradient_sum.index_add_(0, rendered.index, length)
            self.gradient_count.index_add_(0, rendered.index, visible.to(length))

    def note_distances(self) -> None:
        """Bound each Gaussian's size where it is now: see `bound_scales`."""
        means = self.model.raw["means"].detach()
        distance = self.cameras.query(means.nan_to_num().cpu().numpy())[0]
        bound = torch.from_numpy(distance * self.settings.scale_limit).clamp_min(TINY)
        self.log_bound = bound.log().to(means)[:, None]

    @torch.no_grad()
    def bound_scales(self) -> None:
        """Keep scales below `scale_limit` times the distance to the nearest camera, as last noted.

        Choices: EWA takes perspective for linear across a Gaussian, which holds for small ones. A
          needle that reaches past cameras is another haze before each of them, and training fits it
          to those that it has. At a third, three standard deviations end before the nearest camera.
        """
        scales = self.model.raw["log_scales"]
        torch.minimum(scales, self.log_bound, out=scales)

    def grow(
        self, optimizer: torch.optim.Optimizer, members: Tensor, generator: torch.Generator
    ) -> None:
        """Densify: by regions (Eqs 11-12), whose members are i64 [M, n], by classic clone and
        split, or by turns.

        Choices: regions place new Gaussians where a neighbourhood is too sparse, splitting sharpens
          single ones that are too large; turns beat either alone (office0, 2000 steps: 36.2 dB
          against 35.1 and 35.7).
        """
        settings, raw = (
            self.settings,
            {name: value.detach() for name, value in self.model.raw.items()},
        )
        most = settings.max_gaussians
        assert most is not None
        budget = min(max(most - len(self.model), 0), most // max(settings.n_densify, 1))
        self.n_grown += 1
        if budget == 0:
            return
        gradient, threshold = (
            self.gradient_sum / self.gradient_count.clamp_min(1),
            settings.grow_threshold,
        )
        if isinstance(self.model, PrintedScene):
            additions = self.model.additions(gradient, threshold, budget, generator)
        elif settings.densify == "classic" or (
            settings.densify == "mixed" and self.n_grown % 2 == 0
        ):
            additions = densify.clone_or_split(
                raw, gradient, threshold, 0.01 * self.extent, budget, generator
            )
        else:
            mean = densify.region_gradients(gradient, members)
            additions = densify.densify(raw, members, mean, threshold, budget, generator)
        self.n_added += len(additions.parents)
        optimizer_rows.apply_additions(optimizer, self.model.raw, additions)

    @torch.no_grad()
    def remove(self, optimizer: torch.optim.Optimizer, mask: Tensor | None) -> None:
        """Hard-prune faint Gaussians and those that `mask`, which is of the first ones, closes;
        `min_gaussians` stay.
        """
        strength = self.model.raw["logit_opacities"].sigmoid()
        if mask is not None:
            strength[: len(mask)] *= prune.hard_mask(mask)
        keep = strength >= FAINT
        if keep.sum() < self.settings.min_gaussians:
            keep[strength.topk(min(self.settings.min_gaussians, len(strength))).indices] = True
        self.n_removed += int((~keep).sum())
        self._keep(optimizer, keep)

    @torch.no_grad()
    def dim(self, optimizer: torch.optim.Optimizer) -> None:
        """3DGS's reset: no opacity above DIMMED. Those that photos need rise again."""
        opacities = self.model.raw["logit_opacities"]
        opacities.clamp_(max=math.log(DIMMED / (1 - DIMMED)))
        optimizer_rows.forget(optimizer, opacities)
        self.n_reset += 1

    @torch.no_grad()
    def drop_broken(self, optimizer: torch.optim.Optimizer) -> bool:
        """Remove Gaussians with a non-finite value; True if any were removed. Where fewer than
        `min_gaussians` would stay none is.
        """
        sound = torch.ones(len(self.model), dtype=torch.bool, device=self.model.device)
        for value in self.model.raw.values():
            sound[: len(value)] &= finite_rows(value)
        if sound.all() or sound.sum() < min(self.settings.min_gaussians, len(sound)):
            return False
        self.n_broken += int((~sound).sum())
        self._keep(optimizer, sound)
        return True

    def _keep(self, optimizer: torch.optim.Optimizer, rows: Tensor) -> None:
        optimizer_rows.prune_optimizer(optimizer, self.model.raw, rows)
        self.clear_gradients()

    @torch.no_grad()
    def freeze_bands(self, optimizer: torch.optim.Optimizer) -> None:
        """Fix every Gaussian's SH degree, once: closed bands leave parameters and moments."""
        raw = self.model.raw
        degrees = self.model.close_bands().clamp_max(self.settings.sh_degree)
        rows = sh_prune.ragged_rows(degrees)
        optimizer_rows.drop(optimizer, raw, "sh_logits")
        bands = {f"sh{band}": rows[band] for band in range(1, 4)}
        optimizer_rows.reorder_optimizer(
            optimizer, raw, {name: bands.get(name, rows[0]) for name in raw}
        )
        self.clear_gradients()


def finite_rows(value: Tensor) -> Tensor:
    """Rows [N] of a tensor [N, ...] that are finite, bool."""
    return value.isfinite().flatten(1).all(1) if value.ndim > 1 else value.isfinite()


def broken(model: SceneModel) -> str:
    """Names of parameters and weights that are not finite, for a message; empty if all are."""
    rows = [(name, (~finite_rows(value)).nonzero()[:, 0]) for name, value in model.raw.items()]
    parts = [f"{name} of {len(bad)} Gaussians, first {bad[0]}" for name, bad in rows if len(bad)]
    for name, module in model.modules.items():
        parts += [
            f"{name}.{k}" for k, value in module.named_parameters() if not value.isfinite().all()
        ]
    return "not finite: " + ", ".join(parts) if parts else ""
