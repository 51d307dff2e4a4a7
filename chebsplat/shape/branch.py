"""The shape branch of a training: regions of the Gaussians as they are, their encodings, and the gate (Eqs 4-10)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.shape.described import n_degrees
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.shape.fusion import Gate, fuse_in_view, propagate, propagation_weights, share_undefined
from chebsplat.shape.refresh import Descriptors, GaussianIds
from chebsplat.shape.region_inputs import placed
from chebsplat.shape.regions import Regions, regions_of
from chebsplat.splats.rotations import rotation_matrices

CHUNK = 256  # regions that are encoded at once


class FreshEncodings(NamedTuple):
    """Encodings [R, C] with a gradient, of the regions i64 [R], none twice."""

    values: Tensor
    regions: Tensor


class ShapeBranch(nn.Module):
    """Regions of the current Gaussians, their descriptors, and the encoder and gate that use them.

    `encoder` and `gate` are learned. All else follows the Gaussians: `refresh` computes it on the CPU, before any other
    use; what steps read then lies where the Gaussians are. backend: of `rasterize`.
    """

    members: Tensor  # i64 [M, n], -1 where padded
    centers: Tensor  # i64 [M] Gaussians
    descriptors: Tensor  # [M, n, J P]
    positions: Tensor  # [M, n, 3 or 6], see `placed`
    cover: Tensor  # i64 [N, k] regions, -1 where fewer reach a Gaussian
    weights: Tensor  # [N, k] of Eq 8
    cache: Tensor  # [M, C] encodings, as last computed

    def __init__(self, n_channels: int, describe: DescribeSection, train: TrainSection, backend: str = "auto"):
        super().__init__()
        self.describe, self.train_settings, self.backend = describe, train, backend
        per_angle = n_degrees(describe.spectrum, describe.max_degree, describe.from_degree)
        self.n_described = describe.n_angles * per_angle if train.albo else 0
        n_context = n_channels if train.context == "features" else 0
        n_layers = train.n_layers if train.encoder == "transformer" else 0
        n_positions = 6 if train.position == "both" else 3
        sizes = n_channels, train.width, n_layers, train.n_heads, n_positions
        self.encoder = RegionEncoder(self.n_described + n_context, *sizes)
        if n_context:  # unit vectors
            rms = torch.full((n_context,), n_context**-0.5)
            self.encoder.norm_input.set(self.n_described, torch.zeros(n_context), rms)
        self.gate = Gate(n_channels, train.gate_start)
        self.regions: Regions | None = None
        self.described = Descriptors(describe)
        self.ids = GaussianIds()
        self.share_undefined = 0.0  # of covered Gaussians, where Eq 8 as printed is 0 / 0

    def keep(self, rows: Tensor) -> None:
        """Gaussians were removed, all but `rows` [N] bool; those that are added go behind the others unannounced."""
        rows = rows.cpu()
        kept = rows.numpy()
        self.ids.keep(kept)
        if self.regions is not None:
            centers = self.regions.centers
            self.described.keep(rows[torch.as_tensor(centers)])
            self.regions = self.regions._replace(centers=(np.cumsum(kept) - 1)[centers[kept[centers]]])

    def reorder(self, order: Tensor) -> None:
        """The Gaussians were put into another order i64 [N]."""
        places = order.cpu().numpy()
        self.ids.keep(places)
        if self.regions is not None:
            new_index = np.empty(len(places), np.int64)
            new_index[places] = np.arange(len(places))
            self.regions = self.regions._replace(centers=new_index[self.regions.centers])

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
        means, log_scales, quats = (raw[name].detach().cpu() for name in ("means", "log_scales", "quats"))
        if anew:
            self.regions, self.ids = None, GaussianIds()
            self.described.forget()
        if regions is None:
            places, ids = means.double().numpy(), self.ids.of(len(means))
            regions = regions_of(places, self.describe, ids=ids, earlier=self.regions)
        self.regions = regions
        members, centers = torch.as_tensor(regions.members), torch.as_tensor(regions.centers)
        if not self.n_described:
            described = torch.zeros(*members.shape, 0)
        else:
            described = self.described.update(means, quats, log_scales, members, descriptors)
        rows = described[members >= 0]
        if self.n_described and len(rows):
            self.encoder.norm_input.set(0, rows.mean(0), rows.std(0, unbiased=False))
        places, near = placed(means.numpy(), regions, self.train_settings.n_covers, self.train_settings.position)
        positions, cover = torch.from_numpy(places), torch.from_numpy(near)
        frames, scales = rotation_matrices(quats[centers]), log_scales.exp()[centers]
        settings, covered = self.train_settings, (cover, means[centers], frames, scales, regions.radius)
        inflation, temperature = settings.inflation, settings.temperature
        weights = propagation_weights(means, *covered, inflation=inflation, temperature=temperature)
        if inflation == 0:
            self.share_undefined = share_undefined(means, *covered, temperature=temperature)
        device = raw["means"].device
        self.members, self.centers, self.descriptors = members.to(device), centers.to(device), described.to(device)
        self.positions, self.cover, self.weights = positions.to(device), cover.to(device), weights.to(device)
        parts = torch.arange(len(members), device=device).split(CHUNK)
        self.cache = torch.cat([self.encode(raw["features"], part) for part in parts])

    def region_state(self) -> dict[str, Any]:
        """What `refresh` computed and steps have changed since, beside the learned weights; tensors, plain values."""
        regions = self.regions
        assert regions is not None
        return {
            "tensors": [
                self.members,
                self.centers,
                self.descriptors,
                self.positions,
                self.cover,
                self.weights,
                self.cache,
            ],
            "regions": [torch.from_numpy(a) for a in regions[:2]] + [float(v) for v in regions[2:]],
            "ids": self.ids.state_dict(len(self.cover)),
            "described": self.described.state_dict(),
        }

    def load_region_state(self, state: dict[str, Any]) -> None:
        """Go on from what `region_state` returned."""
        self.members, self.centers, self.descriptors, self.positions, *others = state["tensors"]
        self.cover, self.weights, self.cache = others
        centers, members, radius, share = state["regions"]
        self.regions = Regions(centers.numpy(), members.numpy(), radius, share)
        self.ids.load_state_dict(state["ids"])
        self.described.load_state_dict(state["described"])

    def encode(self, features: Tensor, chosen: Tensor) -> Tensor:
        """Encodings [R, C] of the regions `chosen` [R]; tokens see the features without a gradient."""
        members = self.members[chosen]
        inputs = self.descriptors[chosen]
        if self.encoder.n_inputs > self.n_described:
            inputs = torch.cat([inputs, features.detach()[members.clamp_min(0)]], -1)
        encodings: Tensor = self.encoder(inputs, self.positions[chosen], members >= 0)
        return encodings

    def sample(self, features: Tensor, index: Tensor, generator: torch.Generator) -> FreshEncodings:
        """Encode anew `regions_per_step` of the regions that reach the Gaussians `index` [V]; the cache keeps them."""
        is_reached = torch.zeros(len(self.members) + 1, dtype=torch.bool, device=index.device)
        is_reached[self.cover[index]] = True  # the last stands for -1, no region
        reached = is_reached[:-1].nonzero()[:, 0]
        order = torch.randperm(len(reached), generator=generator)[: self.train_settings.regions_per_step]
        chosen = reached[order.to(reached.device)]
        fresh = FreshEncodings(self.encode(features, chosen), chosen)
        self.cache = self.cache.index_copy(0, chosen, fresh.values.detach())
        return fresh

    def fuse(self, features: Tensor, index: Tensor, fresh: FreshEncodings | None = None) -> Tensor:
        """Fused features [V, C] of the Gaussians `index` [V]; encodings are fresh ones, or as the cache has them."""
        fresh = fresh or FreshEncodings(self.cache[:0], index[:0])
        encodings = self.cache, *fresh
        return fuse_in_view(self.gate, features, encodings, self.cover, self.weights, index, self.backend)

    def alone(self) -> Tensor:
        """Features [N, C] of all Gaussians by the cached encodings alone (Eq 9), zero where no region reaches."""
        return propagate(self.cache, self.cover, self.weights)

    def distance(self, features: Tensor, fresh: FreshEncodings) -> Tensor:
        """Mean distance of encodings to the features of their regions' members, which get no gradient.

        Choices: beside the printed losses, which reach the encoder through what the gate lets pass, a few percent:
          by them alone it stays at one vector for all regions. The distance, not its square: a region across an edge
          takes the side that has more members.
        """
        members = self.members[fresh.regions]
        wanted = features.detach()[members.clamp_min(0)]
        mask = members >= 0
        return ((fresh.values[:, None] - wanted).square().sum(-1) + 1e-12).sqrt()[mask].mean()
