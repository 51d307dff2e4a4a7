"""What encoder and gate are fed with, in numpy (Eqs 4-8): the twin of `model.Shape.refresh` for a finished scene."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chebsplat.shape.descriptor_arrays import describe_members
from chebsplat.shape.regions import Regions, build_regions, covering


class Given(NamedTuple):
    """Inputs of the encoder: inputs f32 [M, n, n_inputs], positions f32 [M, n, 3], mask [M, n]. Of the fusion: cover
    i64 [N, k] regions that reach a Gaussian, -1 where fewer do.
    """

    regions: Regions
    inputs: np.ndarray
    positions: np.ndarray
    mask: np.ndarray
    cover: np.ndarray


def prepare(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    features: np.ndarray,
    settings: dict[str, Any],
) -> Given:
    """Regions of Gaussians, their descriptors, and which regions cover a Gaussian.

    Args:
      means [N, 3] scene units, quats [N, 4] wxyz, log_scales [N, 3], features [N, C] before fusion: float32, in the
      order that the scene was trained in (the regions depend on it).
      settings: of `stages.onnx.contract`.
    Raises: ValueError if there are no Gaussians, or the spectrum is cut: that has no route without torch.
    """
    describe = settings["describe"]
    if len(means) == 0:
        raise ValueError("there are no Gaussians")
    regions = build_regions(means.astype(np.float64), describe["n_regions"], describe["region_size"], describe["seed"])
    index, mask = np.maximum(regions.members, 0), regions.members >= 0
    parts = []
    if settings["described"]:
        if describe["spectrum"] != "full":
            raise ValueError(f"describe.spectrum = {describe['spectrum']} is computed by torch only")
        names = ("n_angles", "max_degree", "anisotropy", "bandwidth")
        sizes = {name: describe[name] for name in names}
        described = describe_members(means, quats, np.exp(log_scales), regions.members, **sizes)
        parts.append(described.values.reshape(*mask.shape, -1))
    if settings["context"]:
        parts.append(features[index])
    inputs = np.concatenate(parts, -1) if parts else np.zeros((*mask.shape, 0), np.float32)
    centers = means[regions.centers]
    positions = (means[index] - centers[:, None]) / np.float32(max(regions.radius, 1e-12))
    cover = covering(means, centers, regions.radius, settings["n_covers"])
    return Given(regions, inputs, positions, mask, cover)
