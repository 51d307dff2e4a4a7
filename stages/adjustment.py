"""Poses that a sensor gave, made to agree with the photos: bundle adjustment over triangulated features by pycolmap."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np
    import pycolmap

log = logging.getLogger("chebsplat")

ROUNDS = (48.0, 16.0, 4.0, 2.0)  # pixels that a point may miss its features by, each time it is triangulated
SHARED = 30  # points that a view must see for its pose to be adjusted
ENOUGH = 0.8  # part of the views that must see so many: poses that are adjusted and poses that are not do not mix


def adjust(
    job: Job, model: pycolmap.Reconstruction, database: Path, names: list[str], given: np.ndarray
) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """Poses and focal lengths that the matched features of all views agree on, in the frame of the given poses.

    Args:
      model:    cameras and given poses; database: with matches.
      names:    of the model's images, with their poses `given` [V, 4, 4].
    Returns: the model with its points, and notes: how far poses moved, focal lengths and errors before and after.
    Choices: triangulation and bundle adjustment by turns (`ROUNDS`), under a soft L1 loss of a pixel; the principal
      point stays. The frame is that of the mean rotation, and of the centres under it, of the poses that were given,
      their units with it. A view that shares few points keeps its pose; where many do, all keep theirs.
    """
    import numpy as np
    import pycolmap

    focal, errors, as_given = _focals(model), [], model
    out = job.scratch / "adjusted"
    out.mkdir(exist_ok=True)
    for allowed, status in job.progress.track(ROUNDS, len(ROUNDS), "adjusting"):
        options = pycolmap.IncrementalPipelineOptions()
        options.mapper.filter_max_reproj_error = allowed
        options.triangulation.create_max_angle_error = options.triangulation.continue_max_angle_error = allowed / 4 + 1
        options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = allowed
        model = pycolmap.triangulate_points(
            model, database, job.scratch / "images", out, clear_points=True, options=options, refine_intrinsics=False
        )
        errors.append(float(model.compute_mean_reprojection_error()))
        status["error"] = f"{errors[-1]:.2f} px"
        bundle = pycolmap.BundleAdjustmentOptions()
        bundle.print_summary = False
        bundle.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        pycolmap.bundle_adjustment(model, bundle)
    model.update_point_3d_errors()
    held = {image.name: image for image in model.images.values()}
    found = np.tile(np.eye(4), (len(names), 1, 1))
    found[:, :3] = [held[name].cam_from_world().matrix() for name in names]
    seen = np.array([held[name].num_points3D >= SHARED for name in names])
    if seen.mean() < ENOUGH:
        log.warning("poses stay as given: %d of %d views share %d points or more", seen.sum(), len(seen), SHARED)
        return as_given, {"poses_kept": len(names)}
    scale, rotation, shift = alignment(found[seen], given[seen])
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), shift))
    moved, turned = [], []
    for name, pose, used in zip(names, given, seen, strict=True):
        if not used:
            held[name].frame.set_cam_from_world(held[name].camera_id, pycolmap.Rigid3d(pose[:3]))
            continue
        new = held[name].cam_from_world().matrix()
        moved.append(np.linalg.norm(new[:, :3].T @ new[:, 3] - pose[:3, :3].T @ pose[:3, 3]))
        turned.append(np.degrees(np.arccos(np.clip((np.trace(new[:, :3] @ pose[:3, :3].T) - 1) / 2, -1, 1))))
    notes = {
        "poses_moved": float(np.median(moved)),
        "poses_turned_degrees": float(np.median(turned)),
        "poses_kept": int((~seen).sum()),
        "focal_px": [focal, _focals(model)],
        "reprojection_error_given_px": errors[0],
    }
    log.info(
        "poses adjusted to the photos: moved by %.3g scene units and %.2g° (medians), %d of %d kept; "
        "focal length %.1f -> %.1f px; reprojection error %.2f -> %.2f px",
        *(notes[name] for name in ("poses_moved", "poses_turned_degrees", "poses_kept")), len(names),
        focal, _focals(model), errors[0], model.compute_mean_reprojection_error(),
    )  # fmt: skip
    return model, notes


def alignment(found: np.ndarray, given: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and shift [3] from the world of poses `found` to that of `given`, both [V, 4, 4].

    Choices: the rotation is the mean over views, not that of the centres, which tell none where they lie on a line.
    """
    import numpy as np

    U, _, Vt = np.linalg.svd(np.einsum("vji,vjk->ik", given[:, :3, :3], found[:, :3, :3]))
    rotation = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    old, new = (-np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) for poses in (given, found))
    turned = new @ rotation.T
    spread = ((turned - turned.mean(0)) ** 2).sum()
    scale = float(((old - old.mean(0)) * (turned - turned.mean(0))).sum() / spread) if spread > 0 else 1.0
    return scale, rotation, old.mean(0) - scale * turned.mean(0)


def _focals(model: pycolmap.Reconstruction) -> float:
    """The mean focal length, pixels."""
    import numpy as np

    return float(np.mean([camera.mean_focal_length() for camera in model.cameras.values()]))
