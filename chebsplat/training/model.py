"""The trainable scene: Gaussians with colour and meaning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from chebsplat.rasterize import rasterize
from chebsplat.rasterize.cells import CELL
from chebsplat.rasterize.cuda import made_harmless
from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.splats.gaussians import take
from chebsplat.splats.planes import planes_in_view
from chebsplat.splats.sh import colors_in_view
from chebsplat.training import prune, sh_prune
from chebsplat.training.replay import Replay
from chebsplat.views import View, in_frustum, may_be_seen

BANDS = ("sh0", "sh1", "sh2", "sh3")
NEAREST = 0.01  # scene units, of a plane's depth: the rasterizer's near plane


class RenderOptions(NamedTuple):
    """Options of a call of `SceneModel.render`; size: (width, height)."""

    degree: int
    masked: bool
    semantic: bool
    depth: bool
    size: tuple[int, int]


@dataclass
class Auxiliary:
    """Values that losses need beside the picture; None where not asked for, or not there.

    soft_mask: m̂ [V] of the pruning masks; band_masks [V, 3]; in_view bool [V], None: all are. Of
      the printed method: soft_mask [N] and delta [N, 4] of all Gaussians, fused features [V, C],
      and L_reg [] (`knowledge`).
    """

    soft_mask: Tensor | None = None
    band_masks: Tensor | None = None
    delta: Tensor | None = None
    fused: Tensor | None = None
    knowledge: Tensor | None = None
    in_view: Tensor | None = None


@dataclass
class Rendered:
    """rgb [H, W, 3], alpha [H, W, 1], features [H, W, C], [h, w, C] by cell of the rasterizer, or
    None; `index` [V] the Gaussians in the frustum, None: all, with `means2d` [1, V, 2] and `radii`
    [1, V] in `meta`; planes [H, W, 3], Σ w_i q_i of `planes_in_view`, 1 / scene unit, or None.
    """

    rgb: Tensor
    alpha: Tensor
    features: Tensor | None
    meta: dict[str, Any]
    index: Tensor | None
    auxiliary: Auxiliary
    planes: Tensor | None = None


class SceneModel:
    """Raw parameters by name, each [N, ...] and a leaf tensor.

    `features` [N, C], `prune_logits` [N] and `sh_logits` [N, 3] are there only if the scene needs
    them, and SH band l, `sh<l>` [N_l, 2 l + 1, 3], only for the first N_l Gaussians: all until the
    trainer freezes them.

    Args: raw: of `splats.gaussians.initial_gaussians`, with SH bands or without, on the device that
      is to compute; n_channels: of the features, None without semantics; backend: of `rasterize`,
      and of all else in a step that has a compiled kernel.
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
            # m̂ starts at .73: from a logit of 3 a short training closes none
            self.raw["prune_logits"] = torch.full((n,), 1.0, device=device)
        if train.sh_prune and train.sh_degree > 0:
            self.raw["sh_logits"] = torch.zeros(n, 3, device=device)
        for value in self.raw.values():
            value.requires_grad_(True)
        self.renders_all = device.type == "cuda" and backend != "reference"
        self.replay = Replay(self.renders_all)

    def __len__(self) -> int:
        return len(self.raw["means"])

    @property
    def device(self) -> torch.device:
        """Device of the Gaussians."""
        return self.raw["means"].device

    @property
    def rows(self) -> Tensor:
        """Indices i64 [N] of all Gaussians."""
        return torch.arange(len(self), device=self.device)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules that learn beside raw parameters, by name: those of the printed method."""
        return {}

    def bands(self) -> list[Tensor]:
        """Coefficients [N_l, 2 l + 1, 3] of SH bands 0 to the highest of any Gaussian."""
        return [self.raw[name] for name in BANDS if name in self.raw]

    def sh_kept(self) -> float:
        """Share of SH coefficients up to degree 3 that Gaussians keep, or will at the freeze."""
        counts = [len(band) for band in self.bands()[1:]]
        if "sh_logits" in self.raw:
            counts = (self.open_bands() > 0.5).sum(0).tolist()[: len(counts)]
        n_kept = sum(count * (2 * band + 3) for band, count in enumerate(counts))
        return float((len(self) + n_kept) / (16 * max(len(self), 1)))

    @torch.no_grad()
    def open_bands(self) -> Tensor:
        """Masks [N, 3] in {0, 1} of SH bands 1 to 3, as they are."""
        return sh_prune.band_mask(self.raw["sh_logits"])

    def close_bands(self) -> Tensor:
        """Highest open band u8 [N] of each Gaussian, which keeps it for good."""
        return sh_prune.degrees(self.open_bands())

    def soft_mask(self) -> Tensor | None:
        """m̂ [N] in (0, 1) of the pruning masks of all Gaussians, None where pruning is off."""
        return prune.soft_mask(self.raw["prune_logits"]) if "prune_logits" in self.raw else None

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

        degree: SH bands in use; masked: apply the pruning masks; semantic: render features too;
          grid: features are needed only as means over h × w cells, and rendered so where these are
          the rasterizer's;
        depth: render it too, three channels beside the colours.
        Choices: on a GPU all Gaussians are rendered, since to choose those in view is to wait for
          their number.
        """
        index = None
        if not self.renders_all:
            with torch.no_grad():
                index = in_frustum(self.raw["means"], view, _reach(self.raw))
        options = RenderOptions(degree, masked, semantic, depth, (view.width, view.height))
        activated = self.replay(
            options,
            partial(self._activate, options, tuple(self.raw), index),
            list(self.raw.values()),
            [view.viewmat, view.K],
        )
        gaussians: list[Any] = [
            activated[name] for name in ("means", "quats", "scales", "opacities", "colors")
        ]
        auxiliary = Auxiliary(
            activated.get("soft_mask"),
            activated.get("band_masks"),
            in_view=activated.get("in_view"),
        )
        camera = (view.viewmat[None], view.K[None], view.width, view.height)
        features, cells = activated.get("features"), None
        if index is None:
            render, alpha, meta = rasterize(*gaussians, *camera, backend="cuda", harmless=True)
        elif features is None or (
            grid is not None and options.size == (CELL * grid[1], CELL * grid[0])
        ):
            render, alpha, meta = rasterize(
                *gaussians, *camera, cell_colors=features, backend=self.backend
            )
            cells = None if features is None else meta["cells"][0]
        else:
            gaussians[4] = torch.cat([gaussians[4], features], -1)
            render, alpha, meta = rasterize(*gaussians, *camera, backend=self.backend)
        sizes = [3, 3 * depth, render.shape[-1] - 3 - 3 * depth]
        # one gradient, where slices would make one each
        rgb, planes, rest = render.squeeze(0).split(sizes, -1)
        by_pixel = rest if rest.shape[-1] else None
        return Rendered(
            rgb,
            alpha.squeeze(0),
            by_pixel if cells is None else cells,
            meta,
            index,
            auxiliary,
            planes if depth else None,
        )

    def _activate(
        self, options: RenderOptions, names: tuple[str, ...], index: Tensor | None, *tensors: Tensor
    ) -> dict[str, Tensor]:
        """Values of the Gaussians `index` as the rasterizer takes them, and their masks, by name.

        Args: tensors: the raw parameters of these names; then the view's viewmat and K.
        """
        raw, (viewmat, K) = dict(zip(names, tensors, strict=False)), tensors[-2:]
        means, quats = take(raw["means"], index), take(raw["quats"], index)
        scales, opacities = (
            take(raw["log_scales"], index).exp(),
            take(raw["logit_opacities"], index).sigmoid(),
        )
        activated: dict[str, Tensor] = {}
        if options.masked and "prune_logits" in raw:
            soft = activated["soft_mask"] = prune.soft_mask(take(raw["prune_logits"], index))
            scales, opacities = prune.apply_mask(prune.hard_mask(soft), scales, opacities)
        masks = None
        if options.masked and options.degree > 0 and "sh_logits" in raw:
            masks = activated["band_masks"] = sh_prune.band_mask(take(raw["sh_logits"], index))
        eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
        bands = [raw[name] for name in BANDS if name in raw]
        channels = [
            colors_in_view(bands, masks, index, raw["means"], eye, options.degree, self.backend)
        ]
        if options.depth:
            channels.append(planes_in_view(means, quats, scales, viewmat, K, NEAREST))
        if options.semantic and "features" in raw:
            features = take(raw["features"], index)
            if index is None:
                channels.append(features)
            else:
                activated["features"] = features
        colors = channels[0] if len(channels) == 1 else torch.cat(channels, -1)
        gaussians = (means, quats, scales, opacities, colors)
        if index is None:
            gaussians = made_harmless(*gaussians)
            activated["in_view"] = may_be_seen(
                raw["means"].detach(), View(K, viewmat, *options.size), _reach(raw)
            )
        return activated | dict(
            zip(("means", "quats", "scales", "opacities", "colors"), gaussians, strict=True)
        )


def _reach(raw: Mapping[str, Tensor]) -> Tensor:
    """Three standard deviations [N] of each Gaussian's longest axis, scene units."""
    return 3 * raw["log_scales"].detach().amax(1).exp()
