"""Poses that a sensor gave, made to agree with the photos: bundle adjustment over triangulated
features by pycolmap.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from chebsplat.cameras import centers
from chebsplat.stages.runtime.command import Job

log = logging.getLogger("chebsplat")

# pixels that a point may miss its features by, each time it is triangulated
ROUNDS = (48.0, 16.0, 4.0, 2.0)
FREE = 2  # of these, after which the photos alone have moved the poses about right
SHARED = 30  # points that a view must see for its pose to be adjusted
# part of the views that must see so many: poses that are adjusted and poses that are not do not mix
ENOUGH = 0.8
ASTRAY = 4.0  # times the median, that a view has moved by, from which on it is not believed
MEDIAN_OF_3 = 1.538  # of the length of a vector whose three coordinates have a spread of 1


class Frame(NamedTuple):
    """The world of the given poses as those found tell it: scale, rotation [3, 3] and shift [3]
    into it; led [V] bool: views that see enough points and have not gone astray; spread: how far
    these have turned (radians) and moved (scene units), each coordinate's standard deviation.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    led: np.ndarray
    spread: tuple[float, float]


def adjust(
    job: Job, model: pycolmap.Reconstruction, database: Path, names: list[str], given: np.ndarray
) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """Poses and focal lengths that the matched features of all views agree on, in the frame of the
    given poses.

    Args:
      model:    cameras and given poses; database: with matches.
      names:    of the model's images, with their poses `given` [V, 4, 4].
    Returns: the model with its points, and notes: how far poses moved, focal lengths and errors
      before and after.
    Choices: triangulation and bundle adjustment by turns (`ROUNDS`), under a soft L1 loss of a
      pixel; the principal point stays. The frame is that of the mean rotation, and of the centres
      under it, of the poses that were given, their units with it. After FREE rounds it is known how
      far given poses are off: from then on centres are held by them with that spread, views that
        see few points or were moved much farther than the others begin anew from where
      they were given, and those that are so at the end are found among the points of the others
      (`localized`). Where too many views see few points, all keep their poses.
    """
    focal, errors, as_given = _focals(model), [], model
    out = job.scratch / "adjusted"
    out.mkdir(exist_ok=True)
    framed: Frame | None = None
    for allowed, status in job.progress.track(ROUNDS, len(ROUNDS), "adjusting"):
        model = pycolmap.triangulate_points(
            model, database, job.scratch / "images", out, clear_points=True, options=_triangulation(allowed),
            refine_intrinsics=False,
        )  # fmt: skip
        errors.append(float(model.compute_mean_reprojection_error()))
        status["error"] = f"{errors[-1]:.2f} px"
        bundle = pycolmap.BundleAdjustmentOptions()
        bundle.print_summary = False
        bundle.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        if framed is None or len(errors) <= FREE:
            pycolmap.bundle_adjustment(model, bundle)
        else:
            _bundle_near(model, _images(model, names), given, bundle, framed.spread[1])
        images = _images(model, names)
        seen = np.array([image.num_points3D >= SHARED for image in images])
        framed = frame(_poses(images), given, seen) if seen.mean() >= ENOUGH else None
        if framed is not None:
            model.transform(
                pycolmap.Sim3d(framed.scale, pycolmap.Rotation3d(framed.rotation), framed.shift)
            )
            for row in np.flatnonzero(~framed.led):
                _put(images[row], given[row, :3])
    if framed is None:
        log.warning(
            "poses stay as given: %d of %d views share %d points or more",
            seen.sum(),
            len(seen),
            SHARED,
        )
        return as_given, {"poses_kept": len(names)}
    others = [image for image, led in zip(images, framed.led, strict=True) if led]
    for row in np.flatnonzero(~framed.led):
        _put(
            images[row], localized(model, database, images[row], given[row], framed.spread, others)
        )
    model.update_point_3d_errors()
    notes = _notes(model, framed, differences(_poses(images), given), focal, errors[0])
    return model, notes


def _notes(
    model: pycolmap.Reconstruction,
    framed: Frame,
    found: tuple[np.ndarray, ...],
    focal: float,
    error: float,
) -> dict[str, Any]:
    """What the adjustment has changed. found: how far each view moved and turned; focal, error:
    before, in pixels.
    """
    moved, turned = (values[framed.led] for values in found)
    notes = {
        "poses_moved": float(np.median(moved)),
        "poses_turned_degrees": float(np.degrees(np.median(turned))),
        "poses_kept": int((~framed.led).sum()),
        "focal_px": [focal, _focals(model)],
        "reprojection_error_given_px": error,
    }
    log.info(
        "poses adjusted to the photos: moved by %.3g scene units and %.2g° (medians), %d of %d "
        "held near the given; "
        "focal length %.1f -> %.1f px; reprojection error %.2f -> %.2f px",
        *(notes[name] for name in ("poses_moved", "poses_turned_degrees", "poses_kept")), len(framed.led),
        focal, _focals(model), error, model.compute_mean_reprojection_error(),
    )  # fmt: skip
    return notes


def _triangulation(allowed: float) -> pycolmap.IncrementalPipelineOptions:
    """Options under which a point may miss its features by so many pixels."""
    options = pycolmap.IncrementalPipelineOptions()
    options.mapper.filter_max_reproj_error = allowed
    options.triangulation.create_max_angle_error = (
        options.triangulation.continue_max_angle_error
    ) = allowed / 4 + 1
    options.triangulation.complete_max_reproj_error = (
        options.triangulation.merge_max_reproj_error
    ) = allowed
    return options


def frame(found: np.ndarray, given: np.ndarray, seen: np.ndarray) -> Frame:
    """The world of the poses `given` [V, 4, 4] as those `found` [V, 4, 4] tell it, of views `seen`
    [V] bool.

    Choices: `alignment` of all, then twice of those that have not gone astray.
    """
    led = seen
    for _ in range(3):
        scale, rotation, shift = alignment(found[led], given[led])
        aligned = found.copy()
        aligned[:, :3, :3] = found[:, :3, :3] @ rotation.T
        places = scale * centers(found) @ rotation.T + shift
        aligned[:, :3, 3] = -np.einsum("vij,vj->vi", aligned[:, :3, :3], places)
        moved, turned = differences(aligned, given)
        usual = max(np.median(moved[led]), 1e-12), max(np.median(turned[led]), 1e-12)
        near = (moved <= ASTRAY * usual[0]) & (turned <= ASTRAY * usual[1]) & seen
        led = near if near.sum() > len(seen) / 2 else led
    return Frame(
        scale, rotation, shift, led, (float(usual[1]) / MEDIAN_OF_3, float(usual[0]) / MEDIAN_OF_3)
    )


def differences(poses: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far apart poses [V, 4, 4] are: of their centres, scene units [V], and of their rotations,
    radians [V].
    """
    turns = Rotation.from_matrix(np.einsum("vij,vkj->vik", poses[:, :3, :3], given[:, :3, :3]))
    return np.linalg.norm(centers(poses) - centers(given), axis=1), turns.magnitude()


def localized(
    model: pycolmap.Reconstruction,
    database: Path,
    image: pycolmap.Image,
    given: np.ndarray,
    spread: tuple[float, float],
    others: list[pycolmap.Image],
) -> np.ndarray:
    """The pose [3, 4] of an image by its matches with points of the `others`, near its given pose
    [4, 4].

    Args: spread: each turn's (radians) and shift's (scene units) standard deviation about the given
      pose.
    Choices: the least sum of what its features miss these points by, pixels under a Cauchy loss,
      and of the pose's
      change in units of `spread`: where there are no matches, or they lead astray, the pose is
      the given one.
    """
    points, pixels = [], []
    with pycolmap.Database.open(database) as opened:
        for other in others:
            if opened.exists_two_view_geometry(image.image_id, other.image_id):
                pairs = opened.read_two_view_geometry(image.image_id, other.image_id).inlier_matches
                both = [
                    (mine, other.points2D[its].point3D_id)
                    for mine, its in pairs
                    if other.points2D[its].has_point3D()
                ]
                pixels += [image.points2D[mine].xy for mine, _ in both]
                points += [model.points3D[point].xyz for _, point in both]
    seen, features = np.reshape(points, (-1, 3)), np.reshape(pixels, (-1, 2))
    K = model.cameras[image.camera_id].calibration_matrix()
    turn, place = given[:3, :3], centers(given[None])[0]
    unit = np.maximum(np.repeat(spread, 3), 1e-12)

    def pose(change: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(change[:3]).as_matrix() @ turn
        return np.column_stack([turned, -turned @ (place + change[3:])])

    def residuals(change: np.ndarray) -> np.ndarray:
        there = pose(change)
        local = (seen @ there[:, :3].T + there[:, 3]) @ K.T
        missed = (local[:, :2] / np.maximum(local[:, 2:], 1e-6) - features).ravel()
        return np.concatenate([np.copysign(np.sqrt(np.log1p(missed**2)), missed), change / unit])

    change = least_squares(residuals, np.zeros(6), x_scale=unit).x
    far = np.linalg.norm((change / unit).reshape(2, 3), axis=1).max() > ASTRAY * MEDIAN_OF_3
    return pose(np.zeros(6) if far else change)


def alignment(found: np.ndarray, given: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and shift [3] from the world of poses `found` to that of `given`, both
    [V, 4, 4].

    Choices: the rotation is the mean over views, not that of the centres, which tell none where
      they lie on a line. The scale is 1 where all centres lie in one place.
    """
    U, _, Vt = np.linalg.svd(np.einsum("vji,vjk->ik", given[:, :3, :3], found[:, :3, :3]))
    rotation = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    old, new = centers(given), centers(found)
    turned = new @ rotation.T
    spread = ((turned - turned.mean(0)) ** 2).sum()
    told = spread > (1e-12 * np.abs(turned).max()) ** 2  # more than rounding
    scale = float(((old - old.mean(0)) * (turned - turned.mean(0))).sum() / spread) if told else 1.0
    return scale, rotation, old.mean(0) - scale * turned.mean(0)


def _focals(model: pycolmap.Reconstruction) -> float:
    """The mean focal length, pixels."""
    return float(np.mean([camera.mean_focal_length() for camera in model.cameras.values()]))


def _images(model: pycolmap.Reconstruction, names: list[str]) -> list[pycolmap.Image]:
    """The model's images in the order of their names."""
    held = {image.name: image for image in model.images.values()}
    return [held[name] for name in names]


def _poses(images: list[pycolmap.Image]) -> np.ndarray:
    """Of V images, f64 [V, 4, 4]."""
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    return poses


def _put(image: pycolmap.Image, pose: np.ndarray) -> None:
    """Set the pose [3, 4] of an image."""
    assert image.frame is not None  # every image of a reconstruction has one
    image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))


def _bundle_near(
    model: pycolmap.Reconstruction,
    images: list[pycolmap.Image],
    given: np.ndarray,
    options: pycolmap.BundleAdjustmentOptions,
    spread: float,
) -> None:
    """Bundle adjustment in which the given centres have a say: each coordinate's standard deviation
    is `spread`.
    """
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    for image, place in zip(images, centers(given), strict=True):
        config.add_image(image.image_id)
        prior = pycolmap.PosePrior()
        prior.corr_data_id, prior.position = image.data_id, place
        prior.position_covariance = np.eye(3) * max(spread, 1e-9) ** 2
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    kept = pycolmap.PosePriorBundleAdjustmentOptions()
    pycolmap.create_pose_prior_bundle_adjuster(options, kept, config, priors, model).solve()
