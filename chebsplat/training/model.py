"""The trainable scene: Gaussians with colour and meaning, and the modules that guide them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.rasterize import CELL, rasterize
from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.shape.branch import FreshEncodings, ShapeBranch
from chebsplat.shape.regions import Regions, covering
from chebsplat.splats.gaussians import take
from chebsplat.splats.planes import at_pixels, planes_in_view
from chebsplat.splats.sh import colors_in_view
from chebsplat.training import prune, sh_mask_network, sh_prune
from chebsplat.training.sh_mask_network import BandMaskNetwork
from chebsplat.views import View, in_frustum

NEAREST = 0.01  # scene units, of a plane's depth: the rasterizer's near plane
GATES = {"product": prune.SemanticGate, "printed": prune.PrintedGate}


@dataclass
class Auxiliary:
    """What losses need beside the picture; None where it was not wanted or does not exist.

    soft_mask: m̂ [V] of the pruning gates; band_masks [V, 3]; delta: δ [V, 4] of the printed mask network; fresh:
    encodings that were computed anew, at least one, and shape_distance []: of these to the features of their members.
    """

    soft_mask: Tensor | None = None
    band_masks: Tensor | None = None
    delta: Tensor | None = None
    fresh: FreshEncodings | None = None
    shape_distance: Tensor | None = None


@dataclass
class Rendered:
    """rgb [H, W, 3], alpha [H, W, 1], features [H, W, C], [h, w, C] by cell of the rasterizer, or None; `index` [V]
    the Gaussians in the frustum, with `means2d` [1, V, 2] and `radii` [1, V, 2] in `meta`; inverse_depth [H, W] of the
    Gaussians' planes, Σ w_i / z_i, 1 / scene unit, or None.
    """

    rgb: Tensor
    alpha: Tensor
    features: Tensor | None
    meta: dict[str, Any]
    index: Tensor
    auxiliary: Auxiliary
    inverse_depth: Tensor | None = None


class SceneModel:
    """Raw parameters by name, each [N, ...] and a leaf tensor, and the modules beside them.

    `features` [N, C], `prune_logits` [N] and `sh_logits` [N, 3] are there only if the scene needs them, and SH band l,
    `sh<l>` [N_l, 2 l + 1, 3], only for the first N_l Gaussians: all until the trainer freezes them.

    Args: raw: of `splats.gaussians.initial_gaussians`, with SH bands or without, on the device that is to compute;
      n_channels: of the features, None without semantics; backend: of `rasterize`, and of all else in a step that has
      a compiled kernel.
    """

    def __init__(
        self,
        raw: dict[str, Tensor],
        describe: DescribeSection,
        train: TrainSection,
        n_channels: int | None,
        backend: str = "auto",
    ):
        n, device = len(raw["means"]), raw["means"].device
        self.describe, self.backend = describe, backend
        self.raw = dict(raw)
        for band in range(1, train.sh_degree + 1):
            self.raw.setdefault(f"sh{band}", torch.zeros(n, 2 * band + 1, 3, device=device))
        if n_channels is not None:
            self.raw["features"] = torch.zeros(n, n_channels, device=device)
        if train.prune:
            self.raw["prune_logits"] = torch.full((n,), 1.0, device=device)
        if train.sh_prune and train.sh_degree > 0:
            self.raw["sh_logits"] = torch.zeros(n, 3, device=device)
        for value in self.raw.values():
            value.requires_grad_(True)
        self.shape: ShapeBranch | None = None
        if n_channels and train.trains_encoder:
            self.shape = ShapeBranch(n_channels, describe, train, backend)
        self.semantic_gate: prune.SemanticGate | prune.PrintedGate | None = None
        if n_channels and train.prune and train.prune_semantic:
            self.semantic_gate = GATES[train.prune_gate](n_channels)
        self.band_network: BandMaskNetwork | None = None
        if "sh_logits" in self.raw and train.sh_masks == "printed":
            self.band_network = BandMaskNetwork(n_channels or 0, guided=train.sh_guided)
        self.members = self.nearest = torch.zeros(0, dtype=torch.int64)  # of the regions whose colours guide SH masks
        for module in self.modules.values():  # drawn on the CPU: the same values wherever they are used
            module.to(device)

    def __len__(self) -> int:
        return len(self.raw["means"])

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.raw["means"].device

    @property
    def rows(self) -> Tensor:
        """Indices i64 [N] of all Gaussians."""
        return torch.arange(len(self), device=self.device)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What is learned beside the raw parameters, by name: shape branch and gates, where there are any."""
        parts = {"shape": self.shape, "semantic_gate": self.semantic_gate, "band_network": self.band_network}
        return {name: module for name, module in parts.items() if module is not None}

    def follow(self, regions: Regions) -> None:
        """Printed SH masks are guided by the colours of these regions from now on; others need none."""
        if self.band_network is not None:
            means = self.raw["means"].detach().double().cpu().numpy()
            nearest = covering(means, means[regions.centers], regions.radius, 1)[:, 0]
            self.members = torch.as_tensor(regions.members).to(self.device)
            self.nearest = torch.from_numpy(nearest).to(self.device)

    def bands(self) -> list[Tensor]:
        """Coefficients [N_l, 2 l + 1, 3] of the SH bands, from 0 to the highest that any Gaussian has."""
        return [self.raw[name] for name in ("sh0", "sh1", "sh2", "sh3") if name in self.raw]

    def sh_kept(self) -> float:
        """Part of all SH coefficients up to degree 3 that the Gaussians keep; until the freeze, would keep.

        Printed masks are computed from the features before fusion here: this is for the trace alone.
        """
        counts = [len(band) for band in self.bands()[1:]]
        if "sh_logits" in self.raw:
            open_bands = self.final_band_masks(self.raw.get("features")) > 0.5
            counts = open_bands.sum(0).tolist()[: len(counts)]
        kept = sum(count * (2 * band + 3) for band, count in enumerate(counts))
        return float((len(self) + kept) / (16 * max(len(self), 1)))

    def soft_mask(self, index: Tensor, features: Tensor | None) -> Tensor | None:
        """m̂ [V] in (0, 1) of the pruning gates, None where pruning is off."""
        if "prune_logits" not in self.raw:
            return None
        logits, gate = take(self.raw["prune_logits"], index), self.semantic_gate
        if gate is None or features is None:
            return prune.soft_mask(logits, None)
        if isinstance(gate, prune.PrintedGate):
            soft: Tensor = gate(features.detach(), logits)
            return soft
        return prune.soft_mask(logits, gate(features.detach()))

    def band_masks(self, index: Tensor, features: Tensor | None, eye: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Nested masks [V, 3] of SH bands 1 to 3 with a straight-through gradient, and the printed network's δ [V, 4].

        Args: index [V] Gaussians; features [V, C] theirs; eye [3]: where their regions' colours are seen from.
        Returns: None where SH pruning is off; no δ where logits alone decide.
        """
        if "sh_logits" not in self.raw:
            return None, None
        logits = take(self.raw["sh_logits"], index)
        if self.band_network is None:
            return sh_prune.band_mask(logits), None
        directions = torch.nn.functional.normalize(self.raw["means"].detach() - eye, dim=-1)
        delta = self._delta(logits, index, features, directions[None])
        return sh_mask_network.nested(delta)[:, 1:], delta

    def _delta(self, logits: Tensor, index: Tensor, features: Tensor | None, directions: Tensor) -> Tensor:
        """δ [V, 4] of the printed network; histograms are means over `directions` [Q, N or 1, 3]."""
        network = self.band_network
        assert network is not None
        nearest, histograms = torch.full_like(index, -1), None
        if network.guided:
            nearest = self.nearest[index]
            wanted, rows = nearest[nearest >= 0].unique(return_inverse=True)
            nearest = nearest.masked_scatter(nearest >= 0, rows)
            coefficients, members = sh_mask_network.whole(self.bands()), self.members[wanted]
            parts = [
                sh_mask_network.region_histograms(coefficients, d.expand(len(self), 3), members, network.n_bins)
                for d in directions
            ]
            histograms = torch.stack(parts).mean(0)
        delta: Tensor = network(logits, None if features is None else features.detach(), histograms, nearest)
        return delta

    @torch.no_grad()
    def final_band_masks(self, features: Tensor | None) -> Tensor:
        """Masks [N, 3] as the freeze makes them final: of no view, but of ten directions alike; features [N, C]."""
        logits = self.raw["sh_logits"]
        if self.band_network is None:
            return sh_prune.band_mask(logits)
        directions = sh_prune.guidance_directions()[:, None].to(logits)
        delta = self._delta(logits, self.rows, features, directions)
        return sh_mask_network.nested(delta)[:, 1:]

    def render(
        self,
        view: View,
        degree: int,
        *,
        masked: bool = True,
        semantic: bool = True,
        fused: bool = False,
        generator: torch.Generator | None = None,
        grid: tuple[int, int] | None = None,
        depth: bool = False,
    ) -> Rendered:
        """Colour and features in one pass.

        degree: SH bands in use; masked: apply the pruning masks; semantic: render features too; fused: the fused ones,
        not the raw ones; grid: features are only wanted as means over h × w cells, and rendered so where these are the
        rasterizer's; depth: render it too, three channels beside the colours.
        """
        raw = self.raw
        with torch.no_grad():
            reach = 3 * raw["log_scales"].amax(1).exp()
            index = in_frustum(raw["means"], view, reach)
        means, quats = take(raw["means"], index), take(raw["quats"], index)
        scales, opacities = take(raw["log_scales"], index).exp(), take(raw["logit_opacities"], index).sigmoid()
        auxiliary = Auxiliary()
        features = self._features(index, fused, generator, auxiliary)
        if masked and (soft := self.soft_mask(index, features)) is not None:
            auxiliary.soft_mask = soft
            scales, opacities = prune.apply_mask(prune.hard_mask(soft), scales, opacities)
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        masks = None
        if masked and degree > 0:
            masks, auxiliary.delta = self.band_masks(index, features, eye)
            auxiliary.band_masks = masks
        if not semantic:  # the masks have seen them
            features = None
        colors = colors_in_view(self.bands(), masks, index, raw["means"], eye, degree, self.backend)
        if depth:
            colors = torch.cat([colors, planes_in_view(means, quats, scales, view.viewmat, view.K, NEAREST)], -1)
        n_colors = colors.shape[1]
        gaussians, camera = (means, quats, scales, opacities), (view.viewmat[None], view.K[None])
        size = view.width, view.height
        if features is None or (grid is not None and size == (CELL * grid[1], CELL * grid[0])):
            render, alpha, meta = rasterize(
                *gaussians, colors, *camera, *size, cell_colors=features, backend=self.backend
            )
            cells = None if features is None else meta["cells"][0]
            image, planes = render[0].split([3, 3], -1) if depth else (render[0], None)
            return Rendered(
                image, alpha[0], cells, meta, index, auxiliary, None if planes is None else at_pixels(planes)
            )
        channels = torch.cat([colors, features], -1)
        render, alpha, meta = rasterize(*gaussians, channels, *camera, *size, backend=self.backend)
        sizes = [3, n_colors - 3, channels.shape[1] - n_colors]
        parts = render[0].split(sizes, -1)  # one gradient, where slices would make one each
        inverse_depth = at_pixels(parts[1]) if depth else None
        return Rendered(parts[0], alpha[0], parts[2], meta, index, auxiliary, inverse_depth)

    def _features(
        self, index: Tensor, fused: bool, generator: torch.Generator | None, auxiliary: Auxiliary
    ) -> Tensor | None:
        """Features [V, C] of these Gaussians, fused or raw, None without; some encodings anew, noted in `auxiliary`."""
        raw = self.raw
        if not fused or self.shape is None or self.shape.regions is None:
            return take(raw["features"], index) if "features" in raw else None
        fresh = None if generator is None else self.shape.sample(raw["features"], index, generator)
        features = self.shape.fuse(raw["features"], index, fresh)
        if fresh is not None and len(fresh.regions):
            auxiliary.fresh = fresh
            auxiliary.shape_distance = self.shape.distance(raw["features"], fresh)
        return features

    @torch.no_grad()
    def fused_features(self) -> np.ndarray | None:
        """Fused features [N, C] of all Gaussians, every region encoded; None without an encoder."""
        if self.shape is None:
            return None
        self.shape.refresh(self.raw, anew=True)
        return self.shape.fuse(self.raw["features"], self.rows).cpu().numpy()
