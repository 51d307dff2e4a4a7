"""Exposures of the training photos, in which a training compares renders with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points
from chebsplat.photos.exposures import expected_exposures, measured_exposures
from chebsplat.stages.training.views import training_rows


@dataclass(frozen=True)
class Exposures:
    """Exposures in stops by channel. measured [T, 3]: of the training photos; expected [V, 3]: of a
    photo from each of the points' views, by where it is; spread: standard deviation of those that
    could be measured, 0 of none.
    """

    measured: np.ndarray
    expected: np.ndarray
    spread: float


def exposures_of(capture: Capture, points: Points) -> Exposures:
    """Exposures of a scene's photos, by what they show of the same points. A second or two.

    Choices: a photo that shows too few points has the exposure that is expected of it.
    """
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
    measured = measured_exposures(photos, points.Ks[used], poses, points.means, tracks)
    expected = expected_exposures(measured, poses, points.cam_from_world)
    finite = np.isfinite(measured)
    spread = float(measured[finite.all(1)].std(0).mean()) if finite.any() else 0.0
    return Exposures(np.where(finite, measured, expected[used]), expected, spread)
