"""What is undone of each photo before a training, or learned beside the scene: exposures, and poses."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points
    from chebsplat.training.camera_models import CameraModels
    from chebsplat.views import Views

log = logging.getLogger("chebsplat")
LEAST_SPREAD = 0.05  # stops between the photos' own exposures, from which on they are undone


def camera_models(job: Job, capture: Capture, points: Points, views: Views) -> CameraModels:
    """The models that `train.exposure` and `train.poses` ask for, what is left out with its reason in the log."""
    import torch

    from chebsplat.training.camera_models import CameraModels
    from chebsplat.training.exposure import Exposure
    from chebsplat.training.poses import Poses

    train, exposure, poses = job.config.train, None, None
    if train.exposure == "learned":
        exposure = Exposure(len(views.names), train.lr_exposure, train.weight_exposure, job.device)
    if train.poses == "refined":
        size = capture.size
        row = {name: k for k, name in enumerate(points.names)}
        given = torch.from_numpy(points.cam_from_world[[row[name] for name in views.names]])
        of_scene = torch.from_numpy(points.means)
        poses = Poses(given, views.Ks.cpu(), size, of_scene, train.lr_poses, device=job.device)
    else:
        job.left_out("pose refinement", "train.poses is given")
    return CameraModels(exposure, poses)


def exposures(job: Job, capture: Capture, points: Points) -> np.ndarray | None:
    """What each training photo's exposure [V, 3] differs from its neighbours', to be undone; None where they are left.

    Choices: generated views are alike by construction; elsewhere the photos are measured at the points, at the cost of
      a second or two.
    """
    chosen = job.config.train.exposure
    if chosen == "learned":
        return None
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


def reached(models: CameraModels, views: Views, points: Points) -> np.ndarray:
    """Poses f64 [V, 4, 4] of the points' views after a training: refined of those that it saw, given of the others."""
    poses = points.cam_from_world.copy()
    if models.poses is not None:
        row = {name: k for k, name in enumerate(points.names)}
        poses[[row[name] for name in views.names]] = models.poses.viewmats.cpu().numpy()
    return poses


def facts(models: CameraModels) -> dict[str, Any]:
    """How much was learned: mean turn in degrees and shift in scene units of a pose, mean change of a colour."""
    import numpy as np

    from chebsplat.cameras import centers

    found: dict[str, Any] = {}
    if models.exposure is not None:
        found["exposure"] = float(models.exposure.maps.square().sum((1, 2)).mean().sqrt())
    if models.poses is not None:
        given, now = models.poses.given.cpu().numpy(), models.poses.viewmats.cpu().numpy()
        cosines = (np.einsum("vij,vij->v", given[:, :3, :3], now[:, :3, :3]) - 1) / 2
        shifts = np.linalg.norm(centers(now) - centers(given), axis=1)
        found["poses"] = {"degrees": float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean()), "shift": shifts.mean()}
    return found
