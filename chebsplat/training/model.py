"""The trainable scene: Gaussians with colour and meaning, and the shape encoder that guides them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.rasterize import CELL, rasterize
from chebsplat.shape.descriptor import n_degrees
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.shape.fusion import Gate, propagate, propagation_weights
from chebsplat.shape.fusion_kernels import fuse_in_view
from chebsplat.shape.refresh import Descriptors, Names
from chebsplat.shape.regions import Regions, build_regions, covering
from chebsplat.splats.rotations import rotation_matrices
from chebsplat.splats.sh_kernels import colors_in_view
from chebsplat.training import prune, sh_prune
from chebsplat.views import View, in_frustum


class _Take(torch.autograd.Function):
    """Rows by an index without repeats: the gradient is one scatter, where plain indexing has to accumulate."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor):  # type: ignore[no-untyped-def, override]
        (index,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None


def take(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for an index [V] that holds no row twice."""
    return _Take.apply(values, index)


@dataclass
class Rendered:
    """rgb [H, W, 3], alpha [H, W, 1], features [H, W, C], [h, w, C] by cell of the rasterizer, or None; `index` [V]
    the Gaussians in the frustum."""

    rgb: Tensor
    alpha: Tensor
    features: Tensor | None
    meta: dict[str, Any]
    index: Tensor


class Encoded(NamedTuple):
    """Encodings [R, C] with a gradient, of the regions i64 [R], none twice."""

    values: Tensor
    regions: Tensor


HELD = ("members", "centers", "descriptors", "positions", "cover", "weights", "cache")  # by `Shape`
DESCRIBED = ("given", "mask", "values", "n_described", "n_regions")  # by its `Descriptors`


class Shape(nn.Module):
    """Regions of the current Gaussians, their descriptors, and the encoder and gate that use them (Eqs 4-10)."""

    def __init__(self, n_channels: int, describe: dict[str, Any], train: dict[str, Any]):
        super().__init__()
        self.describe, self.train_settings = describe, train
        per_angle = n_degrees(describe["spectrum"], describe["max_degree"])
        self.n_described = describe["n_angles"] * per_angle if train["albo"] else 0
        n_context = n_channels if train["context"] == "features" else 0
        n_layers = train["n_layers"] if train["encoder"] == "transformer" else 0
        self.encoder = RegionEncoder(
            self.n_described + n_context, n_channels, train["width"], n_layers, train["n_heads"]
        )
        if n_context:  # unit vectors
            rms = torch.full((n_context,), n_context**-0.5)
            self.encoder.norm_input.set(self.n_described, torch.zeros(n_context), rms)
        self.keeps_norm = False  # an earlier scene's constants are kept, with its weights
        self.gate = Gate(n_channels)
        self.regions: Regions | None = None
        names = ("n_angles", "max_degree", "anisotropy", "bandwidth", "spectrum", "n_eigs")
        self.described = Descriptors({k: describe[k] for k in names}, train["refresh_tolerance"])
        self.names = Names()

    def keep(self, rows: Tensor) -> None:
        """Gaussians were removed, all but `rows` [N] bool; those that are added go behind the others unannounced."""
        kept = rows.numpy()
        self.names.keep(kept)
        if self.regions is not None:
            centers = self.regions.centers
            self.described.keep(rows[torch.as_tensor(centers)])
            self.regions = self.regions._replace(centers=(np.cumsum(kept) - 1)[centers[kept[centers]]])

    def reorder(self, order: Tensor) -> None:
        """The Gaussians were put into another order i64 [N]."""
        self.names.keep(order.numpy())
        if self.regions is not None:
            place = np.empty(len(order), np.int64)
            place[order.numpy()] = np.arange(len(order))
            self.regions = self.regions._replace(centers=place[self.regions.centers])

    @torch.no_grad()
    def refresh(
        self,
        raw: dict[str, Tensor],
        regions: Regions | None = None,
        descriptors: Tensor | None = None,
        *,
        anew: bool = False,
    ) -> None:
        """Regions of the Gaussians as they are now; `regions` and `descriptors` spare their computation.

        Centres stay where they still cover the scene, unless `anew`; then the result owes nothing to earlier calls.
        """
        means, settings = raw["means"].detach(), self.describe
        if anew:
            self.regions, self.names = None, Names()
            self.described.forget()
        if regions is None:
            sizes = (settings["n_regions"], settings["region_size"], settings["seed"])
            regions = build_regions(means.double().numpy(), *sizes, ids=self.names.of(len(means)), earlier=self.regions)
        self.regions = regions
        self.members = torch.as_tensor(regions.members)
        self.centers = torch.as_tensor(regions.centers)
        scales = raw["log_scales"].detach().exp()
        if not self.n_described:
            self.descriptors = torch.zeros(*self.members.shape, 0)
        else:
            shapes = raw["quats"].detach(), raw["log_scales"].detach()
            self.descriptors = self.described.update(means, *shapes, self.members, regions.radius, descriptors)
        where = means[self.centers]
        seen = self.descriptors[self.members >= 0]
        if self.n_described and len(seen) and not self.keeps_norm:
            self.encoder.norm_input.set(0, seen.mean(0), seen.std(0, unbiased=False))
        offsets = means[self.members.clamp_min(0)] - where[:, None]
        self.positions = offsets / max(regions.radius, 1e-12)
        cover = covering(means.numpy(), where.numpy(), regions.radius, self.train_settings["n_covers"])
        self.cover = torch.as_tensor(cover)
        frames = rotation_matrices(raw["quats"].detach()[self.centers])
        self.weights = propagation_weights(means, self.cover, where, frames, scales[self.centers], regions.radius)
        self.cache = torch.cat([self.encode(raw["features"], part) for part in self._chunks()])

    def state(self) -> dict[str, Any]:
        """What `refresh` found and steps have changed since, as tensors and plain values."""
        regions, described, ids = self.regions, self.described, self.names.of(len(self.cover))
        assert regions is not None
        return {name: getattr(self, name) for name in HELD} | {
            "regions": [torch.from_numpy(a) for a in regions[:2]] + [float(v) for v in regions[2:]],
            "names": [torch.from_numpy(ids), self.names.next],
            "described": {name: getattr(described, name) for name in DESCRIBED},
        }

    def restore(self, state: dict[str, Any]) -> None:
        for name in HELD:
            setattr(self, name, state[name])
        centers, members, radius, share = state["regions"]
        self.regions = Regions(centers.numpy(), members.numpy(), radius, share)
        self.names.ids, self.names.next = state["names"][0].numpy(), state["names"][1]
        for name, value in state["described"].items():
            setattr(self.described, name, value)

    def _chunks(self) -> tuple[Tensor, ...]:
        return torch.arange(len(self.members)).split(256)

    def encode(self, features: Tensor, chosen: Tensor) -> Tensor:
        """Encodings [R, C] of the regions `chosen` [R]; tokens see the features without a gradient."""
        members = self.members[chosen]
        inputs = self.descriptors[chosen]
        if self.encoder.n_inputs > self.n_described:
            inputs = torch.cat([inputs, features.detach()[members.clamp_min(0)]], -1)
        return self.encoder(inputs, self.positions[chosen], members >= 0)

    def sample(self, features: Tensor, index: Tensor, generator: torch.Generator) -> Encoded:
        """Encode anew `regions_per_step` of the regions that reach the Gaussians `index` [V]; the cache keeps them."""
        cover, is_reached = self.cover[index], torch.zeros(len(self.members), dtype=torch.bool)
        is_reached[cover[cover >= 0]] = True
        reached = is_reached.nonzero()[:, 0]
        order = torch.randperm(len(reached), generator=generator)[: self.train_settings["regions_per_step"]]
        chosen = reached[order]
        fresh = Encoded(self.encode(features, chosen), chosen)
        self.cache = self.cache.index_copy(0, chosen, fresh.values.detach())
        return fresh

    def fuse(self, features: Tensor, index: Tensor, fresh: Encoded | None = None) -> Tensor:
        """Fused features [V, C] of the Gaussians `index` [V]; encodings are fresh ones, or as the cache has them."""
        fresh = fresh or Encoded(self.cache[:0], torch.zeros(0, dtype=torch.int64))
        return fuse_in_view(self.gate, features, (self.cache, *fresh), self.cover, self.weights, index)

    def alone(self) -> Tensor:
        """Features [N, C] of all Gaussians by the cached encodings alone (Eq 9), zero where no region reaches."""
        return propagate(self.cache, self.cover, self.weights)

    def distance(self, features: Tensor, fresh: Encoded) -> Tensor:
        """Mean distance of encodings to the features of their regions' members, which get no gradient.

        Choices: beside the printed losses, which reach the encoder through what the gate lets pass, a few percent:
          by them alone it stays at one vector for all regions. The distance, not its square: a region across an edge
          takes the side that has more members.
        """
        members = self.members[fresh.regions]
        wanted = features.detach()[members.clamp_min(0)]
        mask = members >= 0
        return ((fresh.values[:, None] - wanted).square().sum(-1) + 1e-12).sqrt()[mask].mean()


class SceneModel:
    """Raw parameters by name, each [N, ...] and a leaf tensor, and the modules beside them.

    `features` [N, C], `prune_logits` [N] and `sh_logits` [N, 3] are there only if the scene needs them, and SH band l,
    `sh<l>` [N_l, 2 l + 1, 3], only for the first N_l Gaussians: all until the trainer freezes them.
    """

    def __init__(self, raw: dict[str, Tensor], describe: dict[str, Any], train: dict[str, Any], n_channels: int | None):
        n = len(raw["means"])
        self.raw = dict(raw)
        for band in range(1, train["sh_degree"] + 1):
            self.raw[f"sh{band}"] = torch.zeros(n, 2 * band + 1, 3)
        if n_channels is not None:
            self.raw["features"] = torch.zeros(n, n_channels)
        if train["prune"]:
            self.raw["prune_logits"] = torch.full((n,), 1.0)
        if train["sh_prune"] and train["sh_degree"] > 0:
            self.raw["sh_logits"] = torch.zeros(n, 3)
        for value in self.raw.values():
            value.requires_grad_(True)
        self.shape = Shape(n_channels, describe, train) if n_channels and train["encoder"] != "off" else None
        self.semantic_gate = (
            prune.SemanticGate(n_channels) if n_channels and train["prune"] and train["prune_semantic"] else None
        )

    def __len__(self) -> int:
        return len(self.raw["means"])

    @property
    def modules(self) -> dict[str, nn.Module]:
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
    ) -> tuple[Rendered, dict[str, Tensor]]:
        """Colour and features in one pass; the second result holds masks for the losses.

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
        aside: dict[str, Tensor] = {}
        features = None
        if fused and self.shape is not None and self.shape.regions is not None:
            fresh = None if generator is None else self.shape.sample(raw["features"], index, generator)
            features = self.shape.fuse(raw["features"], index, fresh)
            if fresh is not None and len(fresh.regions):
                aside["shape"] = self.shape.distance(raw["features"], fresh)
        elif "features" in raw:
            features = take(raw["features"], index)
        if masked and (soft := self.soft_mask(index, features)) is not None:
            aside["mask"] = soft
            scales, opacities = prune.apply_mask(prune.hard_mask(soft), scales, opacities)
        if not semantic:  # the masks have seen them
            features = None
        masks = self.sh_mask(index) if masked and degree > 0 else None
        if masks is not None:
            aside["bands"] = masks
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        colors = colors_in_view(self.bands(), masks, index, raw["means"], eye, degree)
        gaussians, camera = (means, quats, scales, opacities), (view.viewmat[None], view.K[None])
        size = view.width, view.height
        if features is None or (grid is not None and size == (CELL * grid[1], CELL * grid[0])):
            render, alpha, meta = rasterize(*gaussians, colors, *camera, *size, cell_colors=features)
            return Rendered(render[0], alpha[0], None if features is None else meta["cells"][0], meta, index), aside
        channels = torch.cat([colors, features], -1)
        render, alpha, meta = rasterize(*gaussians, channels, *camera, *size)
        parts = render[0].split([3, channels.shape[1] - 3], -1)  # one gradient, where two slices would make two
        return Rendered(parts[0], alpha[0], parts[1], meta, index), aside

    @torch.no_grad()
    def fused_features(self) -> np.ndarray | None:
        """Fused features [N, C] of all Gaussians, every region encoded; None without an encoder."""
        if self.shape is None:
            return None
        self.shape.refresh(self.raw, anew=True)
        return self.shape.fuse(self.raw["features"], torch.arange(len(self))).numpy()
