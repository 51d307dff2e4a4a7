"""What a training learns of each photo beside the scene, decided from the capture and points: exposures, and poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points
    from chebsplat.training.camera_models import CameraModels
    from chebsplat.views import Views

LEAST_SPREAD = 0.03  # of the brightness of the same points between photos, above which exposures are learned


def camera_models(job: Job, capture: Capture, points: Points, views: Views) -> CameraModels:
    """The models that `train.exposure` and `train.poses` ask for, each left out or on with its reason in the log."""
    import torch

    from chebsplat.training.camera_models import CameraModels
    from chebsplat.training.exposure import Exposure
    from chebsplat.training.poses import Poses

    train, exposure, poses = job.config.train, None, None
    wanted, why = wants_exposure(job, capture, points)
    if wanted:
        exposure = Exposure(len(views.names), train.lr_exposure, train.weight_exposure, job.device)
    else:
        job.left_out("exposure by photo", why)
    if train.poses == "refined":
        size = capture.size
        row = {name: k for k, name in enumerate(points.names)}
        given = torch.from_numpy(points.cam_from_world[[row[name] for name in views.names]])
        of_scene = torch.from_numpy(points.means)
        poses = Poses(given, views.Ks.cpu(), size, of_scene, train.lr_poses, device=job.device)
    else:
        job.left_out("pose refinement", "train.poses is given")
    return CameraModels(exposure, poses)


def wants_exposure(job: Job, capture: Capture, points: Points) -> tuple[bool, str]:
    """Whether exposures are learned, and why not.

    Choices: generated views are alike by construction; elsewhere the photos are measured at the points, at the cost of
      a second.
    """
    chosen = job.config.train.exposure
    if chosen != "auto":
        return chosen == "on", f"train.exposure is {chosen}"
    if capture.source.get("kind") == "generated":
        return False, "views are generated, all alike"
    spread = measured_spread(capture, points)
    job.facts["exposure_spread"] = spread
    return spread >= LEAST_SPREAD, f"colours of the same points differ by {spread:.1%} between photos"


def measured_spread(capture: Capture, points: Points) -> float:
    """Of the training views, by the points' tracks where they have any."""
    import numpy as np

    from chebsplat.training.exposure import exposure_spread

    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    seen = None
    if len(points.tracks):
        seen = np.zeros((len(points.means), len(points.names)), bool)
        seen[points.tracks[:, 0], points.tracks[:, 1]] = True
        seen = seen[:, used]
    photos = (capture.images[row[points.names[k]]] for k in used)
    return exposure_spread(photos, points.Ks[used], points.cam_from_world[used], points.means, seen)


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
