"""One training of a scene model: schedules, losses, growth and pruning. Arrays in, arrays out;
`Laps` are its seconds by part.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.cameras import centers
from chebsplat.errors import DataFailure
from chebsplat.evaluation.metrics import psnr
from chebsplat.printed.losses import auxiliary_losses
from chebsplat.settings import TrainSection
from chebsplat.shape.regions import regions_of
from chebsplat.splats.exposure import cut_off, exposed
from chebsplat.splats.planes import at_pixels
from chebsplat.training import sh_prune
from chebsplat.training.losses import depth_distance, photometric, semantic_loss
from chebsplat.training.model import Rendered, SceneModel
from chebsplat.training.population import Population, broken
from chebsplat.training.printed import PrintedScene
from chebsplat.training.replay import Replay
from chebsplat.training.schedule import Schedule, optimizer_of
from chebsplat.views import TaughtLabels, Views, Window, reduced

WEIGHT_SSIM = 0.2  # share of SSIM in the colour loss, 3DGS's λ
# steps, at least, from one that looks at a whole photo to the next, while others look at windows
WHOLE = 4
READ_EVERY = 10  # steps on a GPU from one that waits for its figures to the next


class Trainer:
    """Iterate over `steps()`, then call `finish()`.

    Args:
      settings: resolved, nothing left open (`stages.training.defaults`).
      extent:   scene units, scales the means' learning rate.

    The model's device computes; views and cameras must be there, too. On a GPU one step in
    READ_EVERY waits for its figures, the others for nothing: within these a loss that is not finite
    is found. `state_dict()` between two steps holds all that the steps to come depend on: a trainer
    that loads it takes them as this one does, to the bit, with as many threads of torch.
    """

    def __init__(self, model: SceneModel, views: Views, settings: TrainSection, extent: float):
        self.model, self.views, self.settings, self.extent = model, views, settings, extent
        self.schedule = Schedule(settings, max(views.images.shape[1:3]))
        assert settings.feature_every is not None and settings.weight_depth is not None
        self.feature_every, self.weight_depth = settings.feature_every, settings.weight_depth
        self.members = torch.zeros(0, 0, dtype=torch.int64)
        self.optimizer = optimizer_of(self.model, self.settings, self.extent)
        self.order_generator = np.random.default_rng(settings.seed)
        self.generator = torch.Generator().manual_seed(settings.seed)
        # where Gaussians grow, the printed method's Table 5 has a row without semantics
        self.grows_by_color = settings.without == "pruning guidance"
        # a recording has one pass backward
        model.replay = Replay(model.replay.records and not self.grows_by_color)
        if isinstance(model, PrintedScene):
            model.draws = self.generator
        self.order: list[int] = []  # views still to be seen before any is seen again
        self.step = 0
        self.seconds = 0.0  # of the steps but the first
        self.population = Population(model, settings, extent, centers(views.viewmats.cpu().numpy()))
        self.laps = Laps()  # of the same steps; after a resume, from there on
        self.refresh()

    @property
    def share(self) -> float:
        """Part of the budget that is spent."""
        return self.schedule.share(self.step, self.seconds)

    @property
    def reads(self) -> bool:
        """True where this step reads its figures as numbers: always on the CPU, while a GPU's
        tensors are waited for at one step in READ_EVERY alone.
        """
        return self.model.device.type == "cpu" or self.step % READ_EVERY == 0

    def steps(self) -> Iterator[dict[str, float | Tensor]]:
        """Train until the budget is spent; yields each step's figures, unread ones as tensors."""
        while self.share < 1:
            began = time.perf_counter()
            self.laps.start()
            self.step += 1
            # of a budget in steps, with this one; of one in seconds, what was spent before
            share = self.share
            steps = self.schedule.last_step(self.step, self.seconds)
            for group in self.optimizer.param_groups:
                group["lr"] = group["rate"] * self.schedule.rate(group["name"], share, steps)
            self.order = (
                self.order or self.order_generator.permutation(len(self.views.names)).tolist()
            )
            figures = self._step(self.order.pop(), share)
            self._adapt(share)
            self.laps.mark("growth and pruning")
            if self.step == 1:  # kernels were compiled or loaded
                self.laps = Laps()
            else:
                self.seconds += time.perf_counter() - began
            yield figures | {"n": len(self.model)}

    def _adapt(self, share: float) -> None:
        """Growth, pruning, the freeze and refreshes that are due after a step."""
        due = self.step % self.settings.refresh_every == 0
        # a training of few steps does not catch up on growth
        frozen = self.schedule.freezes_bands(share)
        growing = not frozen and self.schedule.grown(share) > self.population.n_grown
        removing = growing or (
            self.schedule.has_grown(share) and self.step % self.settings.remove_every == 0
        )
        # whose regions need finite Gaussians
        if growing or due or isinstance(self.model, PrintedScene):
            self._drop_broken()
        mask = None
        if removing and self.schedule.prunes(share):
            with torch.no_grad():
                mask = self.model.soft_mask()
        if growing:
            self.population.grow(self.optimizer, self.members, self.generator)
        if removing:
            self.population.remove(self.optimizer, mask)
        if self.schedule.reset(share) > self.population.n_reset:
            self.population.dim(self.optimizer)
        if removing or due:
            self.refresh()
        if frozen and "sh_logits" in self.model.raw:
            self.population.freeze_bands(self.optimizer)
            self.refresh()

    def _drop_broken(self) -> None:
        if self.population.drop_broken(self.optimizer):
            self.refresh()
        elif names := broken(self.model):
            raise DataFailure(f"step {self.step}: the training has broken down; {names}")

    def state_dict(self) -> dict[str, Any]:
        """All that the steps to come depend on: tensors (shared, not copied) and plain values."""
        return {
            "raw": {name: value.detach() for name, value in self.model.raw.items()},
            "modules": {name: module.state_dict() for name, module in self.model.modules.items()},
            "optimizer": self.optimizer.state_dict(),
            "order_generator": self.order_generator.bit_generator.state,
            "generator": self.generator.get_state(),
            "population": self.population.state_dict(),
            "progress": (self.step, self.seconds, self.order),
            "members": self.members,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on as the trainer whose `state_dict()` this is, which must not go on itself."""
        model = self.model
        model.raw = {name: value.requires_grad_(True) for name, value in state["raw"].items()}
        for name, module in model.modules.items():
            module.load_state_dict(state["modules"][name])
        self.optimizer = optimizer_of(self.model, self.settings, self.extent)
        self.optimizer.load_state_dict(state["optimizer"])
        self.order_generator.bit_generator.state = state["order_generator"]
        self.generator.set_state(state["generator"])
        self.step, self.seconds, self.order = state["progress"]
        self.members = state["members"]
        self.population.load_state_dict(state["population"])

    def refresh(self) -> None:
        """Regions of the Gaussians as they are now."""
        self.laps.mark("growth and pruning")
        if not isinstance(self.model, PrintedScene):  # which has regions of its own at each step
            means = self.model.raw["means"].detach().double().cpu().numpy()
            regions = regions_of(means, self.model.describe)
            self.members = torch.as_tensor(regions.members).to(self.model.device)
        self.population.note_distances()
        self.laps.mark("refresh")

    def _step(self, index: int, share: float) -> dict[str, float | Tensor]:
        rendered, losses = self.losses_of(index, share, self._window(share))
        loss, values = losses["loss"], torch.stack([value.detach() for value in losses.values()])
        figures = dict(zip(losses, values.tolist() if self.reads else values.unbind(), strict=True))
        if self.reads and not math.isfinite(figures["loss"]):
            bad = [
                name.removeprefix("loss_")
                for name, value in figures.items()
                if not math.isfinite(value)
            ][1:]
            cause = broken(self.model) or "all parameters are finite: look at the view itself"
            raise DataFailure(
                f"step {self.step}, view {self.views.names[index]}: loss {', '.join(bad)} is "
                f"not finite; {cause}"
            )
        self.laps.mark("losses")
        self.optimizer.zero_grad(set_to_none=True)
        if self.grows_by_color:
            losses["loss_color"].backward(retain_graph=True)
            self.population.note_gradients(rendered)
            (loss - losses["loss_color"]).backward()
        else:
            loss.backward()
            self.population.note_gradients(rendered)
        self.laps.mark("backward")
        self.optimizer.step()
        self.population.bound_scales()
        self.laps.mark("optimizer")
        return figures

    def _teaches(self, share: float) -> bool:
        """True where this step teaches features. It then looks at a whole photo, while others look
        at windows: one in WHOLE at most.
        """
        every = (
            max(self.feature_every, WHOLE) if self.schedule.in_full(share) else self.feature_every
        )
        return self.views.features is not None and self.step % every == 0

    def _window(self, share: float) -> Window | None:
        """A random part of a photo that this step sees unreduced; None: all of it, reduced."""
        if not self.schedule.in_full(share) or self._teaches(share):
            return None
        (height, width), by = self.views.images.shape[1:3], self.schedule.reduction
        top, left = self.order_generator.integers(
            0, [height - height // by + 1, width - width // by + 1]
        ).tolist()
        return Window(top, left, height // by, width // by)

    def losses_of(
        self, index: int, share: float, window: Window | None = None
    ) -> tuple[Rendered, dict[str, Tensor]]:
        """A view as this step looks at it, and its losses: `loss`, their sum, and each, weighted,
        as `loss_<name>`.

        Args: index: of the view; share: of the budget that is spent; window: of the photo, None:
          all of it, reduced.
        """
        settings, factor = self.settings, self.schedule.factor(share) if window is None else 1
        pruning, teaches = self.schedule.prunes(share), self._teaches(share)
        target = self.views.features(index) if teaches and self.views.features is not None else None
        read_depth = self.views.depth if self.step % settings.depth_every == 0 else None
        surface = None if read_depth is None else read_depth(index, factor)
        if surface is not None and window is not None:
            surface = window.of(surface)
        rendered = self.model.render(
            self.views.camera(index, factor, window),
            self.schedule.degree(share),
            masked=pruning,
            semantic=teaches,
            grid=None if target is None else (target.shape[0], target.shape[1]),
            depth=surface is not None,
        )
        self.laps.mark("render")
        auxiliary, (photo, mask) = rendered.auxiliary, self.views.photo(index, window)
        labels = None if target is None or self.views.labels is None else self.views.labels(index)
        optional = {
            "photo": photo, "mask": mask, "rgb": rendered.rgb, "target": target,
            "features": rendered.features, "surface": surface, "planes": rendered.planes,
            "alpha": None if rendered.planes is None else rendered.alpha,
            "classes": labels and labels.classes, "confidence": labels and labels.confidence,
            "class_codes": labels and labels.class_codes, "soft_mask": auxiliary.soft_mask,
            "band_masks": auxiliary.band_masks, "in_view": auxiliary.in_view,
            "delta": auxiliary.delta, "knowledge": auxiliary.knowledge,
            "stops": None if self.views.exposures is None else self.views.exposures[index],
        }  # fmt: skip
        inputs = {name: value for name, value in optional.items() if value is not None}
        key = factor, tuple(inputs), labels is not None and labels.complete
        return rendered, self.model.replay(
            key, partial(self._losses, *key), [], list(inputs.values())
        )

    def _losses(
        self, factor: int, names: Sequence[str], complete: bool, *tensors: Tensor
    ) -> dict[str, Tensor]:
        """As `losses_of`, of tensors by their names there (docs/method.md, section 8)."""
        settings, backend, inputs = (
            self.settings,
            self.model.backend,
            dict(zip(names, tensors, strict=True)),
        )
        target, mask = reduced(inputs["photo"], inputs.get("mask"), factor)
        rgb = inputs["rgb"]
        if "stops" in inputs:
            rgb = cut_off(exposed(rgb, inputs["stops"]), target)
        losses = {"color": photometric(rgb, target, mask, WEIGHT_SSIM, backend)}
        if "features" in inputs:
            labels = None
            if "classes" in inputs:
                labels = TaughtLabels(
                    inputs["classes"], inputs["confidence"], inputs["class_codes"], complete
                )
            losses["features"] = semantic_loss(
                inputs["features"], inputs["target"], labels, mask, settings, backend
            )
        if isinstance(self.model, PrintedScene):
            parts = inputs.get("soft_mask"), inputs.get("delta"), inputs.get("knowledge")
            losses |= auxiliary_losses(parts, (settings.weight_mask, settings.weight_sh))
        else:
            if "soft_mask" in inputs:
                losses["mask"] = settings.weight_mask * sh_prune.mean_of(
                    inputs["soft_mask"], inputs.get("in_view")
                )
            if "band_masks" in inputs:
                cost = sh_prune.sh_loss(inputs["band_masks"], inputs.get("in_view"))
                losses["sh"] = settings.weight_sh * cost
        if "planes" in inputs:
            distance = depth_distance(
                at_pixels(inputs["planes"]), inputs["alpha"], inputs["surface"], mask
            )
            losses["depth"] = self.weight_depth * distance
        loss = torch.stack(list(losses.values())).sum()
        if not self.grows_by_color:  # no gradient of one alone is needed
            losses = {name: value.detach() for name, value in losses.items()}
        return {"loss": loss} | {f"loss_{name}": value for name, value in losses.items()}

    @torch.no_grad()
    def held_in_psnr(self, indices: list[int]) -> float:
        """Mean PSNR, dB, of training views' counted pixels at full resolution; 0 of none."""
        scores = []
        for index in indices:
            camera, degree = self.views.camera(index, 1), self.schedule.degree(self.share)
            rgb = self.model.render(camera, degree, semantic=False).rgb
            if self.views.exposures is not None:
                rgb = exposed(rgb, self.views.exposures[index])
            image = (rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()
            mask = None if self.views.masks is None else self.views.masks[index].cpu().numpy()
            truth = self.views.images[index].cpu().numpy()
            if mask is None or mask.any():
                scores.append(
                    psnr(image, truth) if mask is None else psnr(image[mask], truth[mask])
                )
        return float(np.mean(scores or [0.0]))

    @torch.no_grad()
    def finish(self) -> dict[str, np.ndarray]:
        """Final raw parameters: degrees fixed, bands above them zero."""
        self._drop_broken()
        if "sh_logits" in self.model.raw:
            self.population.freeze_bands(self.optimizer)
        bands = [band.detach() for band in self.model.bands()][: self.schedule.degree(1.0) + 1]
        others = self.model.raw.keys() - {"sh1", "sh2", "sh3", "prune_logits"}
        parameters = {name: self.model.raw[name].detach().cpu().numpy() for name in sorted(others)}
        parameters["shN"] = sh_prune.dense(bands[1:], len(self.model)).cpu().numpy()
        parameters["degrees"] = np.zeros(len(self.model), np.uint8)
        for band in bands[1:]:
            parameters["degrees"][: len(band)] += 1
        if isinstance(self.model, PrintedScene):  # what the print renders
            parameters["features"] = self.model.fused_features()
        return parameters


class Laps:
    """Seconds by part of the work: each `mark` books the time since the last mark or start."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin to measure, or go on after a pause that belongs to no part."""
        self.last = time.perf_counter()

    def mark(self, part: str) -> None:
        """Book the seconds since the last mark or start under `part`."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self.last
        self.last = now
