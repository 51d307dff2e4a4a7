"""What encoder and fusion are fed with of regions (Eqs 4-8), in numpy: shared by training and by finished scenes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chebsplat.settings import DescribeSection
from chebsplat.shape.descriptor import describe_members
from chebsplat.shape.regions import Regions, build_regions, covering


class RegionInputs(NamedTuple):
    """Inputs of the encoder: inputs f32 [M, n, n_inputs], positions f32 [M, n, 3], mask [M, n]. Of the fusion: cover
    i64 [N, k] regions that reach a Gaussian, -1 where fewer do.
    """

    regions: Regions
    inputs: np.ndarray
    positions: np.ndarray
    mask: np.ndarray
    cover: np.ndarray


def placed(means: np.ndarray, regions: Regions, n_covers: int) -> tuple[np.ndarray, np.ndarray]:
    """Where members lie and whom regions reach.

    Args: means f32 [N, 3] scene units; n_covers: regions that reach a Gaussian, at most.
    Returns: positions f32 [M, n, 3] relative to the region's centre in radii; cover i64 [N, n_covers], -1 where fewer.
    """
    centers = means[regions.centers]
    positions = (means[np.maximum(regions.members, 0)] - centers[:, None]) / np.float32(max(regions.radius, 1e-12))
    return positions, covering(means, centers, regions.radius, n_covers)


def region_inputs(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    features: np.ndarray,
    describe: DescribeSection,
    *,
    n_covers: int,
    described: bool,
    context: bool,
) -> RegionInputs:
    """Regions of a finished scene, their descriptors, and which regions cover a Gaussian.

    Args:
      means [N, 3] scene units, quats [N, 4] wxyz, log_scales [N, 3], features [N, C] before fusion: float32, in the
      order that the scene was trained in (the regions depend on it).
      described, context: whether tokens hold descriptors, and features.
    Raises: ValueError if there are no Gaussians, or the spectrum is cut: that has no route without torch.
    """
    if len(means) == 0:
        raise ValueError("there are no Gaussians")
    regions = build_regions(means.astype(np.float64), describe.n_regions, describe.region_size, describe.seed)
    mask = regions.members >= 0
    parts = []
    if described:
        if describe.spectrum != "full":
            raise ValueError(f"describe.spectrum = {describe.spectrum} is computed by torch only")
        values = describe_members(means, quats, np.exp(log_scales), regions.members, describe).values
        parts.append(values.reshape(*mask.shape, -1))
    if context:
        parts.append(features[np.maximum(regions.members, 0)])
    inputs = np.concatenate(parts, -1) if parts else np.zeros((*mask.shape, 0), np.float32)
    positions, cover = placed(means, regions, n_covers)
    return RegionInputs(regions, inputs, positions, mask, cover)
