"""describe: anisotropic Chebyshev descriptors of the initial Gaussians (Eqs 1-6)."""

from __future__ import annotations

import numpy as np

from chebsplat.errors import DataFailure
from chebsplat.formats.descriptors import Descriptors, write_descriptors
from chebsplat.formats.points import Points
from chebsplat.shape.descriptor import describe_members
from chebsplat.shape.regions import regions_of
from chebsplat.splats.gaussians import activated, initial_gaussians
from chebsplat.stages.runtime.command import Job


def run(job: Job) -> None:
    """Anisotropic Chebyshev descriptors of regions of the initial Gaussians (Eqs 1-6; docs/method.md, section 2).

    Reads `points`. Writes `descriptors`.
    """
    settings = job.config.describe
    points = Points.read(job.inputs["points"])
    if len(points.means) == 0:
        raise DataFailure("the points artifact holds no points; nothing can be described")
    raw = initial_gaussians(points.means, points.colors, points.covariances)
    regions = regions_of(points.means, settings)
    # Centred in float64, and only then float32: far from the origin the fractions would be lost.
    means = (points.means - points.means.mean(0)).astype(np.float32)
    _, quats, scales, _ = activated(raw)
    described = describe_members(means, quats.numpy(), scales.numpy(), regions.members, settings)
    values = described.values
    if not np.isfinite(values).all():
        bad = int(np.sum(~np.isfinite(values).all((1, 2, 3))))
        raise DataFailure(f"{bad} of {len(values)} regions have non-finite descriptors")
    if settings.n_angles == 1:
        job.left_out("rotations", "describe.n_angles is 1")
    job.facts |= {
        "n_in_float64": described.n_exact,
        "n_regions": len(values),
        "radius": regions.radius,
        "n_values": int(np.prod(values.shape[2:])),
    }
    facts = settings.model_dump(mode="json") | {"radius": regions.radius, "share": regions.share}
    record = Descriptors(regions.centers, regions.members, values, facts)
    write_descriptors(job.out, record)
