"""From regions back to Gaussians: propagation (Eqs 8-9) and the gate that fuses shape with meaning (Eq 10)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from chebsplat.kernels.dispatch import is_compiled
from chebsplat.shape import fusion_kernels
from chebsplat.splats.gaussians import take
from chebsplat.splats.rotations import rotation_matrices

LEAST = 1e-30  # of a squared scale in radii: where the print divides by 0


def propagation_weights(
    means: Tensor,
    cover: Tensor,
    centers: Tensor,
    rotmats: Tensor,
    scales: Tensor,
    radius: float | Tensor,
    *,
    inflation: float = 0.25,
    temperature: float = 1.0,
) -> Tensor:
    """Weight of each covering region at each point (Eq 8).

    Args:
      means:   [N, 3] points, scene units.
      cover:   [N, k] i64 regions that cover a point, -1 where fewer do.
      centers: [M, 3]; rotmats [M, 3, 3], scales [M, 3]: of the Gaussian at each region's centre.
      radius:  of the regions, scene units, > 0.
    Returns: [N, k], rows sum to 1, or to 0 for a point that nothing covers.
    Choices: logits −|S⁻¹RᵀΔ|²/temperature with s² + (inflation · radius)² for s², since the centre's own
      deviations give one region all the weight, or NaN; softmax over the regions that cover the point;
      lengths in radii, so that no unit over- or underflows. An inflation of 0 is the print, held finite by what no
      weight shows: the largest logit is subtracted before the exponential, and no variance is below `LEAST`.
    """
    logits = _logits(means, cover, centers, rotmats, scales, radius, inflation, temperature)
    present = cover >= 0
    absent = ~present & present.any(-1, keepdim=True)  # a point that nothing covers keeps finite logits
    weights = logits.masked_fill(absent, -torch.inf).softmax(-1)
    return torch.where(present, weights, torch.zeros_like(weights))


def share_undefined(
    means: Tensor,
    cover: Tensor,
    centers: Tensor,
    rotmats: Tensor,
    scales: Tensor,
    radius: float,
    *,
    temperature: float = 1.0,
) -> float:
    """Of the points that a region covers, the part whose weights (Eq 8) are 0 / 0 in float32 if computed as printed."""
    covered = (cover >= 0).any(-1)
    logits = _logits(means, cover, centers, rotmats, scales, radius, 0.0, temperature)
    total = logits.float().exp().masked_fill(cover < 0, 0.0).sum(-1)
    return float((total[covered] == 0).float().mean()) if covered.any() else 0.0


def _logits(
    means: Tensor,
    cover: Tensor,
    centers: Tensor,
    rotmats: Tensor,
    scales: Tensor,
    radius: float | Tensor,
    inflation: float,
    temperature: float,
) -> Tensor:
    """Of Eq 8 [N, k], before the softmax."""
    index = cover.clamp_min(0)
    local = torch.einsum("nkji,nkj->nki", rotmats[index], (means[:, None] - centers[index]) / radius)
    deviations = ((scales[index] / radius) ** 2 + inflation**2).clamp_min(LEAST).sqrt()
    return -((local / deviations) ** 2).sum(-1) / temperature  # a variance has no square in the gradient's float32


def fuse_in_view(
    gate: Gate,
    features: Tensor,
    encodings: tuple[Tensor, Tensor, Tensor],
    cover: Tensor,
    weights: Tensor,
    index: Tensor,
    backend: str = "auto",
) -> Tensor:
    """Fused features [V, C] (Eqs 9-10) of the Gaussians `index` i64 [V] (no row twice).

    Args: features [N, C]; encodings: of all regions [M, C], without a gradient, and fresh ones [R, C], with one, that
      take the place of rows i64 [R] of the former (none twice); cover i64 [N, k] and weights [N, k] of
      `propagation_weights`; backend: of `rasterize`.
    """
    if is_compiled(features, backend):
        return fusion_kernels.fuse_in_view(gate.linear, features, encodings, cover, weights, index)
    cache, fresh, chosen = encodings
    shape = propagate(cache.index_copy(0, chosen, fresh), cover[index], weights[index])
    fused: Tensor = gate(take(features, index), shape, cover[index, 0] >= 0)[0]
    return fused


def propagate(encodings: Tensor, cover: Tensor, weights: Tensor) -> Tensor:
    """Shape features [N, C] of points from region encodings [M, C] (Eq 9)."""
    return torch.einsum("nk,nkc->nc", weights, encodings[cover.clamp_min(0)])


class Gate(nn.Module):
    """Fused features g ⊙ features + (1 − g) ⊙ shape, g = sigmoid(linear([shape, features])) (Eq 10).

    Choices: elementwise; the bias starts at `start`, in favour of the features, which are right before the encoder
    is; a point that no region covers keeps its features.
    """

    def __init__(self, n_channels: int, start: float = 3.0):
        super().__init__()
        self.linear = nn.Linear(2 * n_channels, n_channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, start)

    def forward(self, features: Tensor, shape: Tensor, is_covered: Tensor) -> tuple[Tensor, Tensor]:
        """features, shape [N, C], is_covered [N] bool -> fused [N, C], gate [N, C]."""
        gate = self.linear(torch.cat([shape, features], -1)).sigmoid()
        gate = torch.where(is_covered[:, None], gate, torch.ones_like(gate))
        return gate * features + (1 - gate) * shape, gate


class Fusion(nn.Module):
    """Eqs 8-10 in one: from encodings of regions to fused features of Gaussians, with a trained gate."""

    def __init__(self, gate: Gate, inflation: float = 0.25, temperature: float = 1.0):
        super().__init__()
        self.gate, self.inflation, self.temperature = gate, inflation, temperature

    def forward(
        self,
        features: Tensor,
        encodings: Tensor,
        cover: Tensor,
        means: Tensor,
        centers: Tensor,
        quats: Tensor,
        scales: Tensor,
        radius: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """features [N, C], encodings [M, C]; cover [N, k], means [N, 3], centers [M, 3], scales [M, 3] and radius [] as
        of `propagation_weights`; quats [M, 4] of the Gaussians at the centres -> fused [N, C], gate [N, C].
        """
        around = means, cover, centers, rotation_matrices(quats), scales, radius
        weights = propagation_weights(*around, inflation=self.inflation, temperature=self.temperature)
        fused: tuple[Tensor, Tensor] = self.gate(features, propagate(encodings, cover, weights), cover[:, 0] >= 0)
        return fused
