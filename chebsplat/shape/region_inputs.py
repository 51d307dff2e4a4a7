"""What encoder and fusion are fed with of regions (Eqs 4-8), in numpy: shared by training and by finished scenes."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from chebsplat.settings import DescribeSection
from chebsplat.shape.described import compiles
from chebsplat.shape.descriptor import describe_members
from chebsplat.shape.regions import Regions, covering, regions_of

Position = Literal["region", "center", "both"]
FARTHEST = 1e6  # extents: beyond, float32 has no octave left and a token's norm overflows


class RegionInputs(NamedTuple):
    """Inputs of the encoder: inputs f32 [M, n, n_inputs], positions f32 [M, n, 3] or [M, n, 6], mask [M, n]. Of the
    fusion: cover i64 [N, k] regions that reach a Gaussian, -1 where fewer do.
    """

    regions: Regions
    inputs: np.ndarray
    positions: np.ndarray
    mask: np.ndarray
    cover: np.ndarray


def placed(
    means: np.ndarray, regions: Regions, n_covers: int, position: Position = "region"
) -> tuple[np.ndarray, np.ndarray]:
    """Where members lie and whom regions reach.

    Args: means f32 [N, 3] scene units; n_covers: regions that reach a Gaussian, at most.
    Returns: positions f32 [M, n, 3] relative to the region's centre in radii, or of the Gaussians' own centres in the
      scene (`in_scene`, as printed), or [M, n, 6] both, in this order; cover i64 [N, n_covers], -1 where fewer.
    """
    centers, members = means[regions.centers], np.maximum(regions.members, 0)
    parts = []
    if position != "center":
        parts.append((means[members] - centers[:, None]) / np.float32(max(regions.radius, 1e-12)))
    if position != "region":
        parts.append(in_scene(means)[members])
    positions = parts[0] if len(parts) == 1 else np.concatenate(parts, -1)
    return positions, covering(means, centers, regions.radius, n_covers)


def in_scene(means: np.ndarray) -> np.ndarray:
    """Centres [N, 3] of Gaussians in units of their scene: 95 of 100 within ±1 of its centre along every axis.

    Choices: the paper encodes c_i in whatever units a scene comes in, whose highest octave would repeat every few
      centimetres or never. Medians and a quantile, so that a few Gaussians far away do not set the unit; these lie
      within ±`FARTHEST`. An extent below 1e-12 counts as that.
    """
    away = means - np.median(means, axis=0).astype(means.dtype)
    extent = np.quantile(np.abs(away).max(1), 0.95)
    scaled: np.ndarray = away / means.dtype.type(max(extent, 1e-12))
    return scaled.clip(-FARTHEST, FARTHEST)


class Tokens(NamedTuple):
    """An encoder's tokens: how many regions reach a Gaussian at most, whether they hold descriptors, and features, and
    where they lie (see `placed`).
    """

    n_covers: int
    described: bool
    context: bool
    position: Position = "region"


def region_inputs(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    features: np.ndarray,
    describe: DescribeSection,
    tokens: Tokens,
) -> RegionInputs:
    """Regions of a finished scene, their descriptors, and which regions cover a Gaussian.

    Args:
      means [N, 3] scene units, quats [N, 4] wxyz, log_scales [N, 3], features [N, C] before fusion: float32, in the
      order that the scene was trained in (the regions depend on it).
    Raises: ValueError if there are no Gaussians, or its descriptor has no route without torch.
    """
    if len(means) == 0:
        raise ValueError("there are no Gaussians")
    regions = regions_of(means.astype(np.float64), describe)
    mask = regions.members >= 0
    parts = []
    if tokens.described:
        if not compiles(describe.spectrum, describe.metric, describe.axis):
            asked = ", ".join(f"describe.{name} = {getattr(describe, name)}" for name in ("spectrum", "metric", "axis"))
            raise ValueError(f"{asked} is computed by torch only")
        values = describe_members(means, quats, np.exp(log_scales), regions.members, describe).values
        parts.append(values.reshape(*mask.shape, -1))
    if tokens.context:
        parts.append(features[np.maximum(regions.members, 0)])
    inputs = np.concatenate(parts, -1) if parts else np.zeros((*mask.shape, 0), np.float32)
    positions, cover = placed(means, regions, tokens.n_covers, tokens.position)
    return RegionInputs(regions, inputs, positions, mask, cover)
