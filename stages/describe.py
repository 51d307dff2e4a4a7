"""describe: Chebyshev descriptors of the shape about surface points, at four radii (Eqs 1-6)."""

from __future__ import annotations

import numpy as np

from chebsplat.errors import DataFailure
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.points import Points
from chebsplat.shape.point_inputs import N_OWN, RADII, point_inputs, truncation
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.surfaces import Cloud, scene_unit, surface_in, up_of


def run(job: Job) -> None:
    """Describe the shape about points of depth or of a sweep (docs/method.md, section 2).

    Reads `capture` and `points`. Writes `descriptors`. They are of no point where a scene shows too
    little of a surface.
    """
    settings = job.config.describe
    capture, points = Capture.read(job.inputs["capture"]), Points.read(job.inputs["points"])
    unit, unit_from = scene_unit(capture, points.means)
    up, sure = up_of(points.cam_from_world)
    notes = {
        "up_confidence": round(sure, 3),
        "unit_from": unit_from,
        "settings": settings.model_dump(mode="json"),
    }
    try:
        cloud, notes["of"] = surface_in(capture, points, unit)
    except DataFailure as error:
        job.left_out("knowledge of shape", str(error))
        notes["none"] = str(error)
        cloud = Cloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    if settings.n_angles == 1:
        job.left_out("rotations", "describe.n_angles is 1")
    inputs = point_inputs(*cloud, up=up, unit=unit, describe=settings)
    origin = cloud.means.mean(0) if len(cloud.means) else np.zeros(3)
    if not np.isfinite(inputs.descriptors).all():
        bad = int(np.sum(~np.isfinite(inputs.descriptors).all(1)))
        raise DataFailure(
            f"{bad} of {len(inputs.own)} points have descriptors that are not finite; report this"
        )
    lost = truncation(cloud.means, cloud.covariances, up=up, unit=unit, describe=settings)
    job.facts |= {
        "truncation": lost,
        "n_points": len(inputs.own),
        "unit": unit,
        "radii": RADII,
        "n_own": N_OWN,
    } | notes
    Descriptors(*inputs, origin.tolist(), up.tolist(), unit, notes).write(job.out)
