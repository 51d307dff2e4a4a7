"""The trainable scene: Gaussians with colour and meaning, and the modules that guide them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.rasterize import CELL, rasterize
from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.shape.branch import ShapeBranch
from chebsplat.splats.sh_kernels import colors_in_view
from chebsplat.training import prune, sh_prune
from chebsplat.views import View, in_frustum


class _Take(torch.autograd.Function):
    """Rows by an index without repeats: the gradient is one scatter, where plain indexing has to accumulate."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None


def take(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for an index [V] that holds no row twice."""
    rows: Tensor = _Take.apply(values, index)
    return rows


@dataclass
class Auxiliary:
    """What losses need beside the picture; None where it was not wanted or does not exist.

    soft_mask: m̂ [V] of the pruning gates; band_masks [V, 3]; shape_distance []: of encodings that were computed anew
    to the features of their members.
    """

    soft_mask: Tensor | None = None
    band_masks: Tensor | None = None
    shape_distance: Tensor | None = None


@dataclass
class Rendered:
    """rgb [H, W, 3], alpha [H, W, 1], features [H, W, C], [h, w, C] by cell of the rasterizer, or None; `index` [V]
    the Gaussians in the frustum, with `means2d` [1, V, 2] and `radii` [1, V, 2] in `meta`."""

    rgb: Tensor
    alpha: Tensor
    features: Tensor | None
    meta: dict[str, Any]
    index: Tensor
    auxiliary: Auxiliary


class SceneModel:
    """Raw parameters by name, each [N, ...] and a leaf tensor, and the modules beside them.

    `features` [N, C], `prune_logits` [N] and `sh_logits` [N, 3] are there only if the scene needs them, and SH band l,
    `sh<l>` [N_l, 2 l + 1, 3], only for the first N_l Gaussians: all until the trainer freezes them.

    Args: raw: of `splats.gaussians.initial_gaussians`; n_channels: of the features, None without semantics; backend: of
      `rasterize`.
    """

    def __init__(
        self,
        raw: dict[str, Tensor],
        describe: DescribeSection,
        train: TrainSection,
        n_channels: int | None,
        backend: str = "auto",
    ):
        n = len(raw["means"])
        self.describe, self.backend = describe, backend
        self.raw = dict(raw)
        for band in range(1, train.sh_degree + 1):
            self.raw[f"sh{band}"] = torch.zeros(n, 2 * band + 1, 3)
        if n_channels is not None:
            self.raw["features"] = torch.zeros(n, n_channels)
        if train.prune:
            self.raw["prune_logits"] = torch.full((n,), 1.0)
        if train.sh_prune and train.sh_degree > 0:
            self.raw["sh_logits"] = torch.zeros(n, 3)
        for value in self.raw.values():
            value.requires_grad_(True)
        self.shape = ShapeBranch(n_channels, describe, train) if n_channels and train.encoder != "off" else None
        self.semantic_gate = (
            prune.SemanticGate(n_channels) if n_channels and train.prune and train.prune_semantic else None
        )

    def __len__(self) -> int:
        return len(self.raw["means"])

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What is learned beside the raw parameters, by name: shape branch and semantic gate, where there are any."""
        parts = {"shape": self.shape, "semantic_gate": self.semantic_gate}
        return {name: module for name, module in parts.items() if module is not None}

    def bands(self) -> list[Tensor]:
        """Coefficients [N_l, 2 l + 1, 3] of the SH bands, from 0 to the highest that any Gaussian has."""
        return [self.raw[name] for name in ("sh0", "sh1", "sh2", "sh3") if name in self.raw]

    def sh_kept(self) -> float:
        """Part of all SH coefficients up to degree 3 that the Gaussians keep."""
        counts = [len(band) for band in self.bands()[1:]]
        if "sh_logits" in self.raw:
            open_bands = sh_prune.band_mask(self.raw["sh_logits"].detach()) > 0.5
            counts = open_bands.sum(0).tolist()[: len(counts)]
        kept = sum(count * (2 * band + 3) for band, count in enumerate(counts))
        return float((len(self) + kept) / (16 * max(len(self), 1)))

    def soft_mask(self, index: Tensor, features: Tensor | None) -> Tensor | None:
        """m̂ [V] in (0, 1) of the pruning gates, None where pruning is off."""
        if "prune_logits" not in self.raw:
            return None
        semantic = None
        if self.semantic_gate is not None and features is not None:
            semantic = self.semantic_gate(features.detach())
        return prune.soft_mask(take(self.raw["prune_logits"], index), semantic)

    def sh_mask(self, index: Tensor) -> Tensor | None:
        """Nested band masks [V, 3] with a straight-through gradient, None where SH pruning is off."""
        return sh_prune.band_mask(take(self.raw["sh_logits"], index)) if "sh_logits" in self.raw else None

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
    ) -> Rendered:
        """Colour and features in one pass.

        degree: SH bands in use; masked: apply the pruning masks; semantic: render features too; fused: the fused ones,
        not the raw ones; grid: features are only wanted as means over h × w cells, and rendered so where these are the
        rasterizer's.
        """
        raw = self.raw
        with torch.no_grad():
            reach = 3 * raw["log_scales"].amax(1).exp()
            index = in_frustum(raw["means"], view, reach)
        means, quats = take(raw["means"], index), take(raw["quats"], index)
        scales, opacities = take(raw["log_scales"], index).exp(), take(raw["logit_opacities"], index).sigmoid()
        auxiliary = Auxiliary()
        features = None
        if fused and self.shape is not None and self.shape.regions is not None:
            fresh = None if generator is None else self.shape.sample(raw["features"], index, generator)
            features = self.shape.fuse(raw["features"], index, fresh)
            if fresh is not None and len(fresh.regions):
                auxiliary.shape_distance = self.shape.distance(raw["features"], fresh)
        elif "features" in raw:
            features = take(raw["features"], index)
        if masked and (soft := self.soft_mask(index, features)) is not None:
            auxiliary.soft_mask = soft
            scales, opacities = prune.apply_mask(prune.hard_mask(soft), scales, opacities)
        if not semantic:  # the masks have seen them
            features = None
        masks = self.sh_mask(index) if masked and degree > 0 else None
        auxiliary.band_masks = masks
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        colors = colors_in_view(self.bands(), masks, index, raw["means"], eye, degree)
        gaussians, camera = (means, quats, scales, opacities), (view.viewmat[None], view.K[None])
        size = view.width, view.height
        if features is None or (grid is not None and size == (CELL * grid[1], CELL * grid[0])):
            render, alpha, meta = rasterize(
                *gaussians, colors, *camera, *size, cell_colors=features, backend=self.backend
            )
            cells = None if features is None else meta["cells"][0]
            return Rendered(render[0], alpha[0], cells, meta, index, auxiliary)
        channels = torch.cat([colors, features], -1)
        render, alpha, meta = rasterize(*gaussians, channels, *camera, *size, backend=self.backend)
        parts = render[0].split([3, channels.shape[1] - 3], -1)  # one gradient, where two slices would make two
        return Rendered(parts[0], alpha[0], parts[1], meta, index, auxiliary)

    @torch.no_grad()
    def fused_features(self) -> np.ndarray | None:
        """Fused features [N, C] of all Gaussians, every region encoded; None without an encoder."""
        if self.shape is None:
            return None
        self.shape.refresh(self.raw, anew=True)
        return self.shape.fuse(self.raw["features"], torch.arange(len(self))).numpy()
