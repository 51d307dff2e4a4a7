"""The trainable scene: Gaussians with colour and meaning, and the modules that guide them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from chebsplat.rasterize import CELL, rasterize
from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.splats.gaussians import take
from chebsplat.splats.planes import at_pixels, planes_in_view
from chebsplat.splats.sh import colors_in_view
from chebsplat.training import prune, sh_prune
from chebsplat.views import View, in_frustum

NEAREST = 0.01  # scene units, of a plane's depth: the rasterizer's near plane


@dataclass
class Auxiliary:
    """What losses need beside the picture; None where it was not wanted or does not exist.

    soft_mask: m̂ [V] of the pruning gates; band_masks [V, 3]. Of the printed method: soft_mask [N] and delta [N, 4] of
    all Gaussians, fused features [V, C], and L_reg [] (`knowledge`).
    """

    soft_mask: Tensor | None = None
    band_masks: Tensor | None = None
    delta: Tensor | None = None
    fused: Tensor | None = None
    knowledge: Tensor | None = None


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
    """Raw parameters by name, each [N, ...] and a leaf tensor, and the semantic gate beside them.

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
        self.semantic_gate: prune.SemanticGate | None = None
        if n_channels and train.prune and train.prune_semantic:
            self.semantic_gate = prune.SemanticGate(n_channels).to(device)

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
        """What is learned beside the raw parameters, by name: the semantic gate, where there is one."""
        return {} if self.semantic_gate is None else {"semantic_gate": self.semantic_gate}

    def bands(self) -> list[Tensor]:
        """Coefficients [N_l, 2 l + 1, 3] of the SH bands, from 0 to the highest that any Gaussian has."""
        return [self.raw[name] for name in ("sh0", "sh1", "sh2", "sh3") if name in self.raw]

    def sh_kept(self) -> float:
        """Part of all SH coefficients up to degree 3 that the Gaussians keep; until the freeze, would keep."""
        counts = [len(band) for band in self.bands()[1:]]
        if "sh_logits" in self.raw:
            counts = (self.open_bands() > 0.5).sum(0).tolist()[: len(counts)]
        kept = sum(count * (2 * band + 3) for band, count in enumerate(counts))
        return float((len(self) + kept) / (16 * max(len(self), 1)))

    @torch.no_grad()
    def open_bands(self) -> Tensor:
        """Masks [N, 3] in {0, 1} of SH bands 1 to 3, as they are."""
        return sh_prune.band_mask(self.raw["sh_logits"])

    def close_bands(self) -> Tensor:
        """Highest open band u8 [N] of each Gaussian, which keeps it for good."""
        return sh_prune.degrees(self.open_bands())

    def soft_mask(self, index: Tensor, features: Tensor | None) -> Tensor | None:
        """m̂ [V] in (0, 1) of the pruning gates, None where pruning is off."""
        if "prune_logits" not in self.raw:
            return None
        logits, gate = take(self.raw["prune_logits"], index), self.semantic_gate
        if gate is None or features is None:
            return prune.soft_mask(logits, None)
        return prune.soft_mask(logits, gate(features.detach()))

    def render(
        self,
        view: View,
        degree: int,
        *,
        masked: bool = True,
        semantic: bool = True,
        grid: tuple[int, int] | None = None,
        depth: bool = False,
    ) -> Rendered:
        """Colour and features in one pass.

        degree: SH bands in use; masked: apply the pruning masks; semantic: render features too; grid: features are
        only wanted as means over h × w cells, and rendered so where these are the rasterizer's; depth: render it too,
        three channels beside the colours.
        """
        raw = self.raw
        with torch.no_grad():
            reach = 3 * raw["log_scales"].amax(1).exp()
            index = in_frustum(raw["means"], view, reach)
        means, quats = take(raw["means"], index), take(raw["quats"], index)
        scales, opacities = take(raw["log_scales"], index).exp(), take(raw["logit_opacities"], index).sigmoid()
        auxiliary = Auxiliary()
        features = take(raw["features"], index) if "features" in raw else None
        if masked and (soft := self.soft_mask(index, features)) is not None:
            auxiliary.soft_mask = soft
            scales, opacities = prune.apply_mask(prune.hard_mask(soft), scales, opacities)
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        masks = None
        if masked and degree > 0 and "sh_logits" in raw:
            masks = auxiliary.band_masks = sh_prune.band_mask(take(raw["sh_logits"], index))
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
