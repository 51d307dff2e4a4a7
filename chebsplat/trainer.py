"""One training: schedules, losses, growth and pruning of a scene model. Arrays in, arrays out; no files."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat import adapt, cks, sh_prune
from chebsplat.errors import DataFailure
from chebsplat.losses import feature_l1, photometric
from chebsplat.metrics import psnr
from chebsplat.model import Rendered, SceneModel
from chebsplat.regions import Regions, build_regions
from chebsplat.schedule import Schedule
from chebsplat.views import Views

RATES = {
    "means": "lr_means",
    "log_scales": "lr_scales",
    "quats": "lr_quats",
    "logit_opacities": "lr_opacities",
    "sh0": "lr_sh0",
    "sh1": "lr_sh",
    "sh2": "lr_sh",
    "sh3": "lr_sh",
    "features": "lr_features",
    "prune_logits": "lr_masks",
    "sh_logits": "lr_sh_masks",
}
HELD = (
    "step", "seconds", "refresh_seconds", "order", "n_grown", "n_added", "n_removed", "n_broken",
    "members", "guidance", "gradient_sum", "gradient_count",
)  # fmt: skip


class Trainer:
    """Call `refresh()` once, iterate over `steps()`, then call `finish()`.

    Args:
      settings, describe: the config's sections; extent: scene units, scales the means' learning rate.
      basis:    matrices [q, r] by name of an earlier scene's knowledge, empty for none.
    `state()` between two steps holds all that the steps to come depend on: a trainer that is given it by `restore`
    takes them as this one does, to the bit, with as many threads.
    """

    def __init__(
        self,
        model: SceneModel,
        views: Views,
        settings: dict[str, Any],
        describe: dict[str, Any],
        extent: float,
        basis: dict[str, Tensor],
    ):
        self.model, self.views, self.settings, self.describe, self.extent = model, views, settings, describe, extent
        self.basis = basis if model.shape is not None else {}
        self.schedule = Schedule(settings)
        self.guidance: Tensor | None = None
        self.optimizer = self._optimizer()
        self.order_generator = np.random.default_rng(settings["seed"])
        self.generator = torch.Generator().manual_seed(settings["seed"])
        self.order: list[int] = []  # views still to be seen before any is seen again
        self.step = self.n_grown = self.n_added = self.n_removed = self.n_broken = 0
        self.seconds = self.refresh_seconds = 0.0  # of the steps
        self._clear_gradients()

    @property
    def share(self) -> float:
        """Part of the budget that is spent."""
        return self.schedule.share(self.step, self.seconds)

    def _optimizer(self) -> torch.optim.Adam:
        groups = []
        for name, value in self.model.raw.items():
            rate = self.settings[RATES[name]] * (self.extent if name == "means" else 1)
            groups.append({"params": [value], "rate": rate, "name": name})
        weights = [p for module in self.model.modules.values() for p in module.parameters()]
        if weights:
            groups.append({"params": weights, "rate": self.settings["lr_encoder"], "name": "modules"})
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _clear_gradients(self) -> None:
        self.gradient_sum, self.gradient_count = (torch.zeros(len(self.model)) for _ in range(2))

    def steps(self) -> Iterator[dict[str, float]]:
        """Train until the budget is spent; yields each step's figures."""
        while self.share < 1:
            began = time.perf_counter()
            self.step += 1
            share = self.share  # of a budget in steps, with this one; of one in seconds, what was spent before
            for group in self.optimizer.param_groups:
                group["lr"] = group["rate"] * self.schedule.rate(group["name"], share)
            self.order = self.order or self.order_generator.permutation(len(self.views.names)).tolist()
            figures = self._step(self.order.pop(), share)
            self._adapt(share)
            self.seconds += time.perf_counter() - began
            yield figures | {"n": len(self.model)}

    def _adapt(self, share: float) -> None:
        """Growth, pruning, the freeze and refreshes that are due after a step."""
        if self.step % self.settings["refresh_every"] == 0 or self.schedule.grown(share) > self.n_grown:
            self._drop_broken()
        growing = self.schedule.grown(share) > self.n_grown
        if growing:
            self.n_grown = self.schedule.grown(share)
            self._grow()
        if growing or (self.schedule.has("densify_until", share) and self.step % 200 == 0):
            self._remove(share)
            self._clear_gradients()
            self.refresh()
        elif self.step % self.settings["refresh_every"] == 0:
            self.refresh()
        if self.schedule.has("sh_freeze", share):
            self._freeze_bands()

    def state(self) -> dict[str, Any]:
        """All that the steps to come depend on: tensors (shared, not copied) and plain values."""
        return {
            "raw": {name: value.detach() for name, value in self.model.raw.items()},
            "modules": {name: module.state_dict() for name, module in self.model.modules.items()},
            "shape": None if self.model.shape is None else self.model.shape.state(),
            "optimizer": self.optimizer.state_dict(),
            "order_generator": self.order_generator.bit_generator.state,
            "generator": self.generator.get_state(),
        } | {name: getattr(self, name) for name in HELD}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on as the trainer whose `state()` this is; it is not to be used otherwise afterwards."""
        model = self.model
        model.raw = {name: value.requires_grad_(True) for name, value in state["raw"].items()}
        for name, module in model.modules.items():
            module.load_state_dict(state["modules"][name])
        if model.shape is not None:
            model.shape.restore(state["shape"])
        self.optimizer = self._optimizer()
        self.optimizer.load_state_dict(state["optimizer"])
        self.order_generator.bit_generator.state = state["order_generator"]
        self.generator.set_state(state["generator"])
        for name in HELD:
            setattr(self, name, state[name])

    def _encodes(self, share: float) -> bool:
        return self.model.shape is not None and self.schedule.has("encode_from", share)

    def refresh(self, regions: Regions | None = None, descriptors: Tensor | None = None) -> None:
        """Regions, descriptors and band guidance of the Gaussians as they are now."""
        began = time.perf_counter()
        shape, settings = self.model.shape, self.settings
        if shape is not None:
            shape.refresh(self.model.raw, regions, descriptors)
            regions = shape.regions
        elif regions is None:
            means = self.model.raw["means"].detach().double().numpy()
            regions = build_regions(means, *(self.describe[k] for k in ("n_regions", "region_size", "seed")))
        assert regions is not None
        self.members = torch.as_tensor(regions.members)
        if settings["sh_guided"] and "sh_logits" in self.model.raw:
            shN = sh_prune.dense([band.detach() for band in self.model.bands()[1:]], len(self.model))
            self.guidance = sh_prune.region_guidance(shN, self.members, len(self.model))
        self.refresh_seconds += time.perf_counter() - began

    def _step(self, index: int, share: float) -> dict[str, float]:
        settings, factor = self.settings, self.schedule.factor(share)
        target, mask = self.views.target(index, factor)
        pruning = self.schedule.has("prune_from", share)
        rendered, aside = self.model.render(
            self.views.camera(index, factor),
            self.schedule.degree(share),
            masked=pruning,
            fused=self._encodes(share),
            generator=self.generator,
        )
        losses = {"color": photometric(rendered.rgb, target, mask, settings["weight_ssim"])}
        if rendered.features is not None and self.views.features is not None:
            wanted = self.views.features(index)
            losses["features"] = settings["weight_features"] * feature_l1(rendered.features, wanted, mask)
        if "mask" in aside and pruning:
            losses["mask"] = settings["weight_mask"] * aside["mask"].mean()
        if "bands" in aside:
            guidance = None if self.guidance is None else self.guidance[rendered.index]
            losses["sh"] = settings["weight_sh"] * sh_prune.sh_loss(aside["bands"], guidance)
        if self.basis and self.model.shape is not None:
            projections = self.model.shape.encoder.projections()
            losses["basis"] = settings["weight_basis"] * cks.basis_loss(projections, self.basis)
        loss = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(loss):
            bad = [name for name, value in losses.items() if not torch.isfinite(value)]
            where = f"step {self.step}, view {self.views.names[index]}"
            raise DataFailure(f"{where}: loss {', '.join(bad)} is not finite{self._broken()}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._note_gradients(rendered)
        self.optimizer.step()
        return {"loss": float(loss.detach())} | {f"loss_{k}": float(v.detach()) for k, v in losses.items()}

    def _broken(self) -> str:
        """Which parameters are not finite, for a message."""
        rows = {name: ~value.isfinite().reshape(len(value), -1).all(1) for name, value in self.model.raw.items()}
        found = [(name, bad.nonzero()[:, 0]) for name, bad in rows.items()]
        parts = [f"{name} of {len(bad)} Gaussians, first {bad[0]}" for name, bad in found if len(bad)]
        for name, module in self.model.modules.items():
            parts += [f"{name}.{k}" for k, value in module.named_parameters() if not value.isfinite().all()]
        return f"; not finite: {', '.join(parts)}" if parts else "; all parameters are finite: look at the view itself"

    def _note_gradients(self, rendered: Rendered) -> None:
        """Length of the total loss' gradient to the 2D means, in half image widths as gsplat counts it."""
        gradient = rendered.meta["means2d"].grad
        if gradient is None:
            return
        height, width = rendered.rgb.shape[:2]
        length = (gradient[0] * torch.tensor([0.5 * width, 0.5 * height])).norm(dim=-1)
        seen = rendered.meta["radii"][0] > 0
        index = rendered.index[seen]
        self.gradient_sum[index] += length[seen]
        self.gradient_count[index] += 1

    def _grow(self) -> None:
        """Densify: by regions (Eqs 11-12) or by classic clone and split."""
        settings = self.settings
        left = max(settings["max_gaussians"] - len(self.model), 0)
        budget = min(left, settings["max_gaussians"] // max(settings["n_densify"], 1))
        gradient = self.gradient_sum / self.gradient_count.clamp_min(1)
        if budget == 0:
            return
        raw = {name: value.detach() for name, value in self.model.raw.items()}
        if settings["densify"] == "classic":
            additions = adapt.clone_or_split(
                raw, gradient, settings["grow_threshold"], 0.01 * self.extent, budget, self.generator
            )
        else:
            mean = adapt.region_gradients(gradient, self.members)
            additions = adapt.densify(raw, self.members, mean, settings["grow_threshold"], budget, self.generator)
        self.n_added += len(additions.parents)
        adapt.apply_additions(self.optimizer, self.model.raw, additions)

    @torch.no_grad()
    def _remove(self, share: float) -> None:
        """Hard-prune what is masked out or too faint, but never below `min_gaussians`."""
        settings, raw = self.settings, self.model.raw
        strength = raw["logit_opacities"].sigmoid()
        if self.schedule.has("prune_from", share):
            features = raw.get("features")
            if self.model.semantic_gate is not None and self._encodes(share) and self.model.shape is not None:
                self.refresh()
                features = self.model.shape.fuse(raw["features"], torch.arange(len(self.model)))
            soft = self.model.soft_mask(torch.arange(len(self.model)), features)
            strength = strength if soft is None else strength * adapt.hard_mask(soft)
        keep = strength >= 0.005
        if keep.sum() < settings["min_gaussians"]:
            keep[strength.topk(min(settings["min_gaussians"], len(strength))).indices] = True
        self.n_removed += int((~keep).sum())
        self._keep(keep)

    def _keep(self, rows: Tensor) -> None:
        adapt.prune_optimizer(self.optimizer, self.model.raw, rows)
        if self.model.shape is not None:
            self.model.shape.keep(rows)

    @torch.no_grad()
    def _drop_broken(self) -> None:
        """Remove Gaussians that a step has made non-finite; `n_broken` counts them."""
        sound = torch.ones(len(self.model), dtype=torch.bool)
        for value in self.model.raw.values():
            sound[: len(value)] &= value.isfinite().reshape(len(value), -1).all(1)
        if not sound.all():
            self.n_broken += int((~sound).sum())
            self._keep(sound)
            self._clear_gradients()
            self.refresh()

    @torch.no_grad()
    def _freeze_bands(self) -> None:
        """Fix every Gaussian's SH degree: what is closed leaves parameters, moments and memory."""
        raw, shape = self.model.raw, self.model.shape
        if "sh_logits" not in raw:
            return
        degrees = sh_prune.degrees(sh_prune.band_mask(raw["sh_logits"])).clamp_max(self.settings["sh_degree"])
        rows = sh_prune.ragged_rows(degrees)
        adapt.drop(self.optimizer, raw, "sh_logits")
        bands = {f"sh{band}": rows[band] for band in range(1, 4)}
        adapt.reorder_optimizer(self.optimizer, raw, {name: bands.get(name, rows[0]) for name in raw})
        self._clear_gradients()
        if shape is not None:
            shape.reorder(rows[0])
        self.refresh()

    @torch.no_grad()
    def held_in_psnr(self, indices: list[int]) -> float:
        """Mean PSNR over training views at full resolution, dB."""
        scores = []
        for index in indices:
            rendered, _ = self.model.render(self.views.camera(index, 1), self.schedule.degree(self.share))
            image = (rendered.rgb.clamp(0, 1) * 255).round().byte().numpy()
            mask = None if self.views.masks is None else self.views.masks[index].numpy()
            truth = self.views.images[index].numpy()
            scores.append(psnr(image, truth) if mask is None else psnr(image[mask], truth[mask]))
        return float(np.mean(scores))

    @torch.no_grad()
    def finish(self) -> dict[str, np.ndarray]:
        """Final raw parameters: degrees fixed, bands above them zero, fused features of every Gaussian."""
        self._drop_broken()
        weights = [weight for module in self.model.modules.values() for weight in module.parameters()]
        if not all(weight.isfinite().all() for weight in weights):
            raise DataFailure(f"step {self.step}: the training has broken down{self._broken()}")
        self._freeze_bands()
        bands = [band.detach() for band in self.model.bands()][: self.schedule.degree(1.0) + 1]
        others = self.model.raw.keys() - {"sh1", "sh2", "sh3", "prune_logits"}
        parameters = {name: self.model.raw[name].detach().numpy() for name in sorted(others)}
        parameters["shN"] = sh_prune.dense(bands[1:], len(self.model)).numpy()
        parameters["degrees"] = np.zeros(len(self.model), np.uint8)
        for band in bands[1:]:
            parameters["degrees"][: len(band)] += 1
        fused = self.model.fused_features()
        return parameters if fused is None else parameters | {"fused": fused}
