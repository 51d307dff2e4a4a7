"""Exposures of single photos, undone before a training."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from chebsplat.stages.runtime.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points

log = logging.getLogger("chebsplat")
LEAST_SPREAD = 0.05  # stops between the photos' own exposures, from which on they are undone


def exposures(job: Job, capture: Capture, points: Points) -> np.ndarray | None:
    """Difference of each training photo's exposure [V, 3] from its neighbours', to be undone; None where it is left.

    Choices: generated views are alike by construction; elsewhere the photos are measured at the points, at the cost of
      a second or two.
    """
    chosen = job.config.train.exposure
    if chosen == "off" or (chosen == "auto" and capture.source.get("kind") == "generated"):
        why = "train.exposure is off" if chosen == "off" else "views are generated, all alike"
        job.left_out("exposure by photo", why)
        return None
    import numpy as np

    from chebsplat.photos.exposures import own_part

    measured, poses = exposures_of(capture, points)
    known = measured[np.isfinite(measured).all(1)]
    own = own_part(measured, poses)
    spread = float(own.std(0).mean())
    job.facts["exposure_stops"] = {"all": float(known.std(0).mean()) if len(known) else None, "own": spread}
    if chosen == "auto" and spread < LEAST_SPREAD:
        job.left_out("exposure by photo", f"photos differ by {spread:.2f} stops from those about them")
        return None
    log.info("exposures of photos differ by %.2f stops from those about them: undone", spread)
    return own


def exposures_of(capture: Capture, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Exposures of the training views in stops, by the points' tracks where they have any; and these views' poses."""
    import numpy as np

    from chebsplat.photos.exposures import measured_exposures

    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    tracks = None
    if len(points.tracks):
        column = np.full(len(points.names), -1)
        column[used] = np.arange(len(used))
        tracks = np.stack([points.tracks[:, 0], column[points.tracks[:, 1]]], 1)
        tracks = tracks[tracks[:, 1] >= 0]
    photos = (capture.images[row[points.names[k]]] for k in used)
    poses = points.cam_from_world[used]
    return measured_exposures(photos, points.Ks[used], poses, points.means, tracks), poses
