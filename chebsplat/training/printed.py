"""The paper's method in the trainer: a scene whose steps run the modules of `chebsplat.printed`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from chebsplat.printed import densification, encoding, knowledge, propagation, pruning, sh_pruning
from chebsplat.printed.descriptor import descriptor
from chebsplat.printed.fusion import Gate
from chebsplat.printed.regions import Regions, regions_of
from chebsplat.rasterize import rasterize
from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.splats.gaussians import covariances, take
from chebsplat.splats.sh import colors_in_view
from chebsplat.training.densify import Additions
from chebsplat.training.model import Auxiliary, Rendered, SceneModel
from chebsplat.views import View, in_frustum

REGIONS_IN_VIEW = 256
N_LAYERS, N_HEADS = 2, 4
TEMPERATURE = 1.0  # tau of Eq 8
THRESHOLD = 0.1  # of soft masks, of Gaussians and of SH bands
SOFTNESS = 100.0  # gamma of Eq 13: a bin's edge is about a tenth of a colour's usual range
CANDIDATES, MOST_CANDIDATES = 8, 32  # in a region of the mean number of points, and in any (Eq 12)
NEAREST, FARTHEST = 0.5, 2.0  # of a candidate to its neighbour, in the scene's median spacings
# |grad f| above which a region grows, by the features' gradient: a quarter of office0's do
STEEP_FEATURES = 2.5e-5
KAPPA, EPSILON, ETA = 1.0, 0.2, 0.9  # of the knowledge space's growth (Eq 15)


class Modules(nn.Module):
    """Learned modules of the printed method. without: the part of Table 5 that is left out."""

    in_view: Tensor

    def __init__(self, n_channels: int, describe: DescribeSection, without: str):
        super().__init__()
        self.width = describe.n_angles * (describe.max_degree + 1)  # Q
        self.encoder: encoding.Encoder | encoding.PointMLP
        if without in ("descriptor", "transformer"):
            self.encoder = encoding.PointMLP(self.width, n_channels)
        else:
            self.encoder = encoding.Encoder(self.width, n_channels, N_LAYERS, N_HEADS)
        self.gate = Gate(n_channels)
        self.pruning = None if without == "pruning guidance" else pruning.PruningGate(n_channels)
        self.band_masks = None if without == "SH guidance" else sh_pruning.BandMasks(n_channels)
        self.modulation = knowledge.Modulation(self.width)
        # part of the Gaussians that views see, their running mean
        self.register_buffer("in_view", torch.ones(()))


class Encoded(NamedTuple):
    """Of the Gaussians `index`: fused and shape features [V, C].

    regions: of positions in `index`, not of Gaussians' numbers, with tokens [M, t, Q] and
      descriptors [M, n, Q].
    """

    fused: Tensor
    shape: Tensor
    regions: Regions
    tokens: Tensor
    descriptors: Tensor


class PrintedScene(SceneModel):
    """A `SceneModel` by the print: `sh_logits` are [N, 4], and fused features go into everything.

    bases: B of each key projection matrix, by name, of the scenes before; empty: none. Regions,
      descriptors and weights of Eq 8 are those of the Gaussians as they are at a step, without
      gradient to means and covariances.
    """

    def __init__(
        self,
        raw: dict[str, Tensor],
        describe: DescribeSection,
        train: TrainSection,
        n_channels: int,
        backend: str = "auto",
    ):
        self.printed, self.without = Modules(n_channels, describe, train.without), train.without
        super().__init__(raw, describe, train, n_channels, backend)
        if "sh_logits" in self.raw:
            self.raw["sh_logits"] = torch.zeros(
                len(self), 4, device=self.device, requires_grad=True
            )
        self.angles = torch.arange(describe.n_angles) * (2 * math.pi / describe.n_angles)
        self.draws = torch.Generator()  # the trainer's, once there is one; of steps alone
        self.seed, self.bases = train.seed, dict[str, Tensor]()
        self.grows_by_features = train.region_gradient == "features"

    @property
    def modules(self) -> dict[str, nn.Module]:
        return {"printed": self.printed}

    def encoded(self, index: Tensor, count: int) -> Encoded:
        """Fused features of the Gaussians `index` [V] by `count` regions of them (Eqs 1-10).

        Where nothing learns, what is drawn is the same at every call: measuring changes no
        training.
        """
        raw, parts = self.raw, self.printed
        draws = self.draws if torch.is_grad_enabled() else torch.Generator().manual_seed(self.seed)
        with torch.no_grad():
            points = raw["means"][index]
            spreads = covariances(
                raw["quats"][index].double(), raw["log_scales"][index].double().exp()
            )
            regions = regions_of(points, count, self.describe.region_size, draws)
            rows, present = regions.members.clamp_min(0), regions.members >= 0
            largest = (
                raw["log_scales"][index].amax(1).exp().square().median() if len(index) else 1.0
            )
            described = points.new_zeros(*rows.shape, parts.width)
            if self.without != "descriptor":
                described = descriptor(
                    points[rows],
                    spreads[rows].to(points),
                    present,
                    self.angles,
                    beta=self.describe.anisotropy / float(largest),
                    sigma=self.describe.bandwidth * regions.radius,
                    n_eigs=self.describe.n_eigs,
                    degree=self.describe.max_degree,
                )
            middle = regions.centers
            places = points.double(), points[middle].double()
            shares = propagation.weights(*places, spreads[middle], regions.pairs, TEMPERATURE).to(
                points
            )
            covered = torch.zeros(len(index), dtype=torch.bool)
            covered[regions.pairs[0]] = True
        tokens = parts.encoder.tokens(described, points[rows])
        encodings = parts.encoder(tokens, present)
        shape = propagation.propagate(encodings, shares, regions.pairs, len(index))
        fused = parts.gate(shape, take(raw["features"], index), covered)
        return Encoded(fused, shape, regions, tokens, described)

    def masks(
        self, features: Tensor, index: Tensor, regions: Regions
    ) -> tuple[Tensor | None, Tensor | None]:
        """Soft masks [N] of all Gaussians and [N, 4] of their SH bands; None where switched off.

        Args: features [N, C]: fused where they are in the regions of the Gaussians `index`, else
          their own.
        """
        raw, parts = self.raw, self.printed
        soft = delta = None
        if "prune_logits" in raw:
            logits = raw["prune_logits"]
            soft = logits.sigmoid() if parts.pruning is None else parts.pruning(features, logits)
        if "sh_logits" in raw:
            logits = raw["sh_logits"]
            if parts.band_masks is None:
                delta = (logits + sh_pruning.STARTS_AT).sigmoid()
            else:
                members = torch.where(regions.members >= 0, index[regions.members.clamp_min(0)], -1)
                bins = parts.band_masks.n_bins
                histograms = sh_pruning.region_histograms(self.bands(), members, bins, SOFTNESS)
                region = torch.full((len(self),), -1, dtype=torch.int64)
                region[index] = regions.nearest(raw["means"].detach()[index])
                delta = parts.band_masks(features, logits, histograms, region)
        return soft, delta

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
        """As `SceneModel.render`, by the print; features are fused at every step."""
        raw = self.raw
        with torch.no_grad():
            index = in_frustum(raw["means"], view, 3 * raw["log_scales"].amax(1).exp())
        fused, _, regions, tokens, _ = self.encoded(index, REGIONS_IN_VIEW)
        if fused.requires_grad:
            self.printed.in_view.lerp_(torch.tensor(len(index) / max(len(self), 1)), 0.1)
        if self.grows_by_features and fused.requires_grad:
            fused.retain_grad()
        soft = delta = None
        if masked:
            soft, delta = self.masks(raw["features"].index_copy(0, index, fused), index, regions)
        scales, opacities = (
            take(raw["log_scales"], index).exp(),
            take(raw["logit_opacities"], index).sigmoid(),
        )
        if soft is not None:
            scales, opacities = pruning.apply_mask(
                pruning.binarize(soft[index], THRESHOLD), scales, opacities
            )
        bands = self.bands()
        if delta is not None:
            open_bands = pruning.binarize(delta, THRESHOLD)
            bands = [band * open_bands[:, i, None, None] for i, band in enumerate(bands)]
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        colors = colors_in_view(bands, None, index, raw["means"], eye, degree, self.backend)
        channels = torch.cat([colors, fused], -1) if semantic else colors
        gaussians = take(raw["means"], index), take(raw["quats"], index), scales, opacities
        camera = view.viewmat[None], view.K[None], view.width, view.height
        render, alpha, meta = rasterize(*gaussians, channels, *camera, backend=self.backend)
        image, features = render[0].split([3, channels.shape[1] - 3], -1)
        auxiliary = Auxiliary(soft_mask=soft, delta=delta, fused=fused)
        auxiliary.knowledge = self._pull(tokens, regions)
        return Rendered(image, alpha[0], features if semantic else None, meta, index, auxiliary)

    def _pull(self, tokens: Tensor, regions: Regions) -> Tensor | None:
        """L_reg (Eq 14): mean over projection matrices, alpha over regions; None without bases."""
        if not self.bases or not len(regions.centers):
            return None
        present = nn.functional.pad(regions.members >= 0, (1, 0), value=True)
        alpha = self.printed.modulation(tokens, present).mean()
        maps = self.printed.encoder.key_projections()
        pulls = [knowledge.regularizer(maps[name], B, alpha) for name, B in self.bases.items()]
        return torch.stack(pulls).mean()

    @property
    def n_regions(self) -> int:
        """Regions of the whole scene, as dense as in a view."""
        return math.ceil(REGIONS_IN_VIEW / max(float(self.printed.in_view), 0.01))

    @torch.no_grad()
    def whole(self) -> Encoded:
        """Of all Gaussians.

        Choices: the print fuses within a view's frustum; a scene that is stored has one feature a
          Gaussian.
        """
        return self.encoded(self.rows, self.n_regions)

    @torch.no_grad()
    def soft_mask(self) -> Tensor | None:
        """Soft mask [N] by fused features of the whole scene."""
        whole = self.whole()
        return self.masks(whole.fused, self.rows, whole.regions)[0]

    @torch.no_grad()
    def open_bands(self) -> Tensor:
        """Masks [N, 3] of SH bands 1 to 3, which are not nested."""
        return self._open()[:, 1:].float()

    @torch.no_grad()
    def close_bands(self) -> Tensor:
        """Zero closed bands, the lowest included; returns the highest open ones u8 [N]."""
        is_open = self._open()
        for band, mask in zip(self.bands(), is_open.unbind(1), strict=False):
            band.mul_(mask[:, None, None])
        degrees = torch.arange(4, device=self.device) * is_open
        return degrees.amax(1).to(torch.uint8)

    def _open(self) -> Tensor:
        """Mask [N, 4], bool, of the SH bands 0 to 3 that are open."""
        whole = self.whole()
        delta = self.masks(whole.fused, self.rows, whole.regions)[1]
        assert delta is not None
        return delta > THRESHOLD

    @torch.no_grad()
    def fused_features(self) -> np.ndarray:
        """Fused features [N, C] of all Gaussians."""
        fused: np.ndarray = self.whole().fused.cpu().numpy()
        return fused

    @torch.no_grad()
    def grown_bases(self) -> dict[str, Tensor]:
        """The knowledge after this scene (Eq 15): sigma_f is the mean over regions."""
        whole = self.whole()
        sigma = float(knowledge.spread(whole.descriptors, whole.regions.members >= 0).mean())
        return {
            name: knowledge.update(
                W, self.bases.get(name), sigma, kappa=KAPPA, epsilon=EPSILON, eta=ETA
            )
            for name, W in self.printed.encoder.key_projections().items()
        }

    @torch.no_grad()
    def histograms(self) -> dict[str, Any]:
        """Histograms of gates and masks: shares in ten bins of [0, 1]."""
        whole = self.whole()
        soft, delta = self.masks(whole.fused, self.rows, whole.regions)
        gate = self.printed.gate.values(whole.shape, self.raw["features"])
        parts = {"gate": gate, "mask": soft}
        if delta is not None:
            parts |= {f"sh{degree}": column for degree, column in enumerate(delta.unbind(1))}
        return {
            name: (values.flatten().histc(10, 0, 1) / max(values.numel(), 1)).tolist()
            for name, values in parts.items()
            if values is not None
        }

    @torch.no_grad()
    def additions(
        self, gradient: Tensor, threshold: float, budget: int, generator: torch.Generator
    ) -> Additions:
        """New Gaussians in regions of steep gradient [N] (Eqs 11-12), the steepest first, `budget`
        at most.

        Choices: alpha_d is such that a region of the mean number of points gets CANDIDATES; V_pc is
          the ball's. Bounds of the distance are NEAREST and FARTHEST times the scene's median
          spacing.
        """
        means = self.raw["means"].detach()
        regions = regions_of(means, self.n_regions, self.describe.region_size, generator)
        mean = densification.mean_gradients(gradient, regions.pairs, len(regions.centers))
        if self.grows_by_features:
            threshold = STEEP_FEATURES
        n_points = torch.bincount(regions.pairs[1], minlength=len(regions.centers))
        volume = densification.ball_volume(regions.radius)
        density = CANDIDATES * float(n_points.double().mean()) / volume
        counts = densification.candidate_counts(
            torch.full_like(mean, volume), n_points, density, MOST_CANDIDATES
        )
        order = mean.argsort(descending=True, stable=True)
        order = order[mean[order] > threshold]
        middle = means[regions.centers[order]].repeat_interleave(counts[order], 0)
        candidates = densification.in_ball(middle, regions.radius, generator)
        spacing = _median_spacing(means)
        mask, parents = densification.accepted(
            candidates, means, NEAREST * spacing, FARTHEST * spacing
        )
        candidates, parents = candidates[mask][:budget], parents[mask][:budget]
        rows = {name: value.detach()[parents] for name, value in self.raw.items()}
        return Additions(parents, rows | {"means": candidates}, {})


def _median_spacing(means: Tensor) -> float:
    """Median distance of points [N, 3] to their nearest other one, scene units."""
    places = means.double().numpy()
    return float(np.median(cKDTree(places).query(places, 2)[0][:, 1])) if len(places) > 1 else 1.0
