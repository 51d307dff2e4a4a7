"""describe: anisotropic Chebyshev descriptors of the initial Gaussians (Eqs 1-6)."""

from __future__ import annotations

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job, command


def run(job: Job) -> None:
    import numpy as np
    import torch

    from chebsplat.descriptor import describe_members
    from chebsplat.formats.descriptors import Descriptors, write_descriptors
    from chebsplat.formats.points import read_points
    from chebsplat.gaussians import activated, initial_gaussians
    from chebsplat.regions import build_regions

    settings = job.config.describe
    points = read_points(job.inputs["points"])
    if len(points.means) == 0:
        raise DataFailure("the points artifact holds no points; nothing can be described")
    raw = initial_gaussians(points.means, points.colors, points.covariances)
    regions = build_regions(points.means, settings.n_regions, settings.region_size, settings.seed)
    sizes = settings.model_dump(include={"n_angles", "max_degree", "anisotropy", "bandwidth"})
    values = describe_members(*activated(raw)[:3], torch.as_tensor(regions.members), **sizes).numpy()
    if not np.isfinite(values).all():
        bad = int(np.sum(~np.isfinite(values).all((1, 2, 3))))
        raise DataFailure(f"{bad} of {len(values)} regions have non-finite descriptors")
    if settings.n_angles == 1:
        job.left_out("rotations", "describe.n_angles is 1")
    job.facts |= {"n_regions": len(values), "radius": regions.radius, "n_values": int(np.prod(values.shape[2:]))}
    record = Descriptors(regions.centers, regions.members, values, settings.model_dump(mode="json"))
    write_descriptors(job.out, record)


main = command("describe", run)
