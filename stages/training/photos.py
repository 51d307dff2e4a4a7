"""Exposures of the training photos, which a training can undo."""

from __future__ import annotations

from typing import Any

import numpy as np

from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points
from chebsplat.photos.exposures import measured_exposures, own_part
from chebsplat.stages.training.views import training_rows


def own_exposures(capture: Capture, points: Points) -> tuple[np.ndarray, dict[str, Any]]:
    """Difference of each training photo's exposure [V, 3] from its neighbours', in stops; and the
    spread of `all` and of these `own` parts, None where no exposure is known. A second or two.
    """
    measured, poses = exposures_of(capture, points)
    finite = measured[np.isfinite(measured).all(1)]
    own = own_part(measured, poses)
    return own, {
        "all": float(finite.std(0).mean()) if len(finite) else None,
        "own": float(own.std(0).mean()),
    }


def exposures_of(capture: Capture, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Exposures of the training views in stops, by the points' tracks, if any; and their poses."""
    row = {name: view for view, name in enumerate(capture.names)}
    used = training_rows(capture, points)
    tracks = None
    if len(points.tracks):
        column = np.full(len(points.names), -1)
        column[used] = np.arange(len(used))
        tracks = np.stack([points.tracks[:, 0], column[points.tracks[:, 1]]], 1)
        tracks = tracks[tracks[:, 1] >= 0]
    photos = (capture.images[row[points.names[k]]] for k in used)
    poses = points.cam_from_world[used]
    return measured_exposures(photos, points.Ks[used], poses, points.means, tracks), poses
