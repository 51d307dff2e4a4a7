"""Adjustment of a sensor's poses to the photos: bundle adjustment over matches, by pycolmap."""

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
ASTRAY = 4.0  # times the median move, beyond which a view is an outlier
MEDIAN_OF_3 = 1.538  # of the length of a vector whose three coordinates have a spread of 1


class Frame(NamedTuple):
    """Similarity into the world of reference poses: scale, rotation [3, 3] and shift [3]; led [V]
    bool: views that see enough points and are no outliers; spread: standard deviation of their
    turns (radians) and moves (scene units), of each coordinate.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    led: np.ndarray
    spread: tuple[float, float]


def adjust(
    job: Job,
    model: pycolmap.Reconstruction,
    database: Path,
    names: list[str],
    sensor_poses: np.ndarray,
) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """Poses and focal lengths by bundle adjustment, in the frame of the sensor's poses.

    Args: model: cameras and the sensor's poses; database: with matches; names: of the model's
      images; sensor_poses [V, 4, 4]: theirs.
    Returns: the model with its points, and notes: motion of the poses, focal lengths and errors
      before and after.
    Choices: triangulation and bundle adjustment by turns (`ROUNDS`), under a soft L1 loss of a
      pixel; the principal point stays. The frame is aligned to the sensor's by the mean rotation,
      and by the centres under it, scale included. After FREE rounds the error of the sensor's poses
      is estimated: from then on their centres are priors of that spread, and views that see few
      points or moved much farther than the others start again from the sensor's pose; such views
      of the last round are located by the points of the others (`localized`). Where too many views
      see few points, all keep their poses.
    """
    focal, errors, unchanged = _focals(model), [], model
    out = job.scratch / "adjusted"
    out.mkdir(exist_ok=True)
    framed: Frame | None = None
    for allowed, status in job.progress.track(ROUNDS, len(ROUNDS), "adjusting"):
        model = pycolmap.triangulate_points(
            model,
            database,
            job.scratch / "images",
            out,
            clear_points=True,
            options=_triangulation(allowed),
            refine_intrinsics=False,
        )
        errors.append(float(model.compute_mean_reprojection_error()))
        status["error"] = f"{errors[-1]:.2f} px"
        bundle = pycolmap.BundleAdjustmentOptions()
        bundle.print_summary = False
        bundle.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        if framed is None or len(errors) <= FREE:
            bundle_all(model, bundle)
        else:
            _bundle_near(model, _images(model, names), sensor_poses, bundle, framed.spread[1])
        images = _images(model, names)
        supported = np.array([image.num_points3D >= SHARED for image in images])
        framed = (
            frame(_poses(images), sensor_poses, supported) if supported.mean() >= ENOUGH else None
        )
        if framed is not None:
            model.transform(
                pycolmap.Sim3d(framed.scale, pycolmap.Rotation3d(framed.rotation), framed.shift)
            )
            for row in np.flatnonzero(~framed.led):
                _put(images[row], sensor_poses[row, :3])
    if framed is None:
        log.warning(
            "poses stay as given: %d of %d views share %d points or more",
            supported.sum(),
            len(supported),
            SHARED,
        )
        return unchanged, {"poses_kept": len(names)}
    others = [image for image, led in zip(images, framed.led, strict=True) if led]
    for row in np.flatnonzero(~framed.led):
        _put(
            images[row],
            localized(model, database, images[row], sensor_poses[row], framed.spread, others),
        )
    model.update_point_3d_errors()
    notes = _notes(model, framed, differences(_poses(images), sensor_poses), focal, errors[0])
    return model, notes


def _notes(
    model: pycolmap.Reconstruction,
    framed: Frame,
    motions: tuple[np.ndarray, ...],
    focal: float,
    error: float,
) -> dict[str, Any]:
    """Log and return the changes. motions: moves and turns; focal, error: before, in pixels."""
    moved, turned = (values[framed.led] for values in motions)
    notes = {
        "poses_moved": float(np.median(moved)),
        "poses_turned_degrees": float(np.degrees(np.median(turned))),
        "poses_kept": int((~framed.led).sum()),
        "focal_px": [focal, _focals(model)],
        "reprojection_error_given_px": error,
    }
    log.info(
        "poses adjusted to the photos: moved by %.3g scene units and %.2g° (medians), %d of %d "
        "held near the given; focal length %.1f -> %.1f px; reprojection error %.2f -> %.2f px",
        notes["poses_moved"],
        notes["poses_turned_degrees"],
        notes["poses_kept"],
        len(framed.led),
        focal,
        _focals(model),
        error,
        model.compute_mean_reprojection_error(),
    )
    return notes


def _triangulation(allowed: float) -> pycolmap.IncrementalPipelineOptions:
    """Options with this bound on reprojection errors, pixels."""
    options = pycolmap.IncrementalPipelineOptions()
    options.mapper.filter_max_reproj_error = allowed
    options.triangulation.create_max_angle_error = (
        options.triangulation.continue_max_angle_error
    ) = allowed / 4 + 1
    options.triangulation.complete_max_reproj_error = (
        options.triangulation.merge_max_reproj_error
    ) = allowed
    return options


def frame(poses: np.ndarray, reference: np.ndarray, supported: np.ndarray) -> Frame:
    """Similarity from the world of `poses` [V, 4, 4] to that of `reference` [V, 4, 4].

    Args: supported [V] bool: views that see enough points.
    Choices: `alignment` of all supported views, then twice of those that are no outliers.
    """
    led = supported
    for _ in range(3):
        scale, rotation, shift = alignment(poses[led], reference[led])
        aligned = poses.copy()
        aligned[:, :3, :3] = poses[:, :3, :3] @ rotation.T
        places = scale * centers(poses) @ rotation.T + shift
        aligned[:, :3, 3] = -np.einsum("vij,vj->vi", aligned[:, :3, :3], places)
        moved, turned = differences(aligned, reference)
        usual = max(np.median(moved[led]), 1e-12), max(np.median(turned[led]), 1e-12)
        near = (moved <= ASTRAY * usual[0]) & (turned <= ASTRAY * usual[1]) & supported
        led = near if near.sum() > len(supported) / 2 else led
    return Frame(
        scale, rotation, shift, led, (float(usual[1]) / MEDIAN_OF_3, float(usual[0]) / MEDIAN_OF_3)
    )


def differences(poses: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of centres, scene units [V], and of rotations, radians [V], of poses [V, 4, 4]."""
    turns = Rotation.from_matrix(np.einsum("vij,vkj->vik", poses[:, :3, :3], reference[:, :3, :3]))
    return np.linalg.norm(centers(poses) - centers(reference), axis=1), turns.magnitude()


def localized(
    model: pycolmap.Reconstruction,
    database: Path,
    image: pycolmap.Image,
    prior: np.ndarray,
    spread: tuple[float, float],
    others: list[pycolmap.Image],
) -> np.ndarray:
    """The pose [3, 4] of an image by matches with points of the `others` and its `prior` [4, 4].

    Args: spread: standard deviation of each turn (radians) and shift (scene units) of the prior.
    Choices: least squares of reprojection errors, pixels under a Cauchy loss, and of the pose's
      change in units of `spread`. Without matches, or where these lead far off, it is the prior.
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
    anchors, features = np.reshape(points, (-1, 3)), np.reshape(pixels, (-1, 2))
    K = model.cameras[image.camera_id].calibration_matrix()
    turn, place = prior[:3, :3], centers(prior[None])[0]
    unit = np.maximum(np.repeat(spread, 3), 1e-12)

    def pose(change: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(change[:3]).as_matrix() @ turn
        return np.column_stack([turned, -turned @ (place + change[3:])])

    def residuals(change: np.ndarray) -> np.ndarray:
        there = pose(change)
        local = (anchors @ there[:, :3].T + there[:, 3]) @ K.T
        missed = (local[:, :2] / np.maximum(local[:, 2:], 1e-6) - features).ravel()
        return np.concatenate([np.copysign(np.sqrt(np.log1p(missed**2)), missed), change / unit])

    change = least_squares(residuals, np.zeros(6), x_scale=unit).x
    far = np.linalg.norm((change / unit).reshape(2, 3), axis=1).max() > ASTRAY * MEDIAN_OF_3
    return pose(np.zeros(6) if far else change)


def alignment(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3], shift [3] from the world of poses `source` [V, 4, 4] to `target`'s.

    Choices: the rotation is the mean over views, not that of the centres, which is undetermined
      where they lie on a line. The scale is 1 where all centres coincide.
    """
    U, _, Vt = np.linalg.svd(np.einsum("vji,vjk->ik", target[:, :3, :3], source[:, :3, :3]))
    rotation = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    old, new = centers(target), centers(source)
    turned = new @ rotation.T
    spread = ((turned - turned.mean(0)) ** 2).sum()
    has_extent = spread > (1e-12 * np.abs(turned).max()) ** 2  # more than rounding
    scale = (
        float(((old - old.mean(0)) * (turned - turned.mean(0))).sum() / spread)
        if has_extent
        else 1.0
    )
    return scale, rotation, old.mean(0) - scale * turned.mean(0)


def _focals(model: pycolmap.Reconstruction) -> float:
    """The mean focal length, pixels."""
    return float(np.mean([camera.mean_focal_length() for camera in model.cameras.values()]))


def _images(model: pycolmap.Reconstruction, names: list[str]) -> list[pycolmap.Image]:
    """The model's images in the order of their names."""
    by_name = {image.name: image for image in model.images.values()}
    return [by_name[name] for name in names]


def _poses(images: list[pycolmap.Image]) -> np.ndarray:
    """Of V images, f64 [V, 4, 4]."""
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    return poses


def _put(image: pycolmap.Image, pose: np.ndarray) -> None:
    """Set the pose [3, 4] of an image."""
    assert image.frame is not None  # every image of a reconstruction has one
    image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))


def bundle_all(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Bundle adjustment of a whole model, in place.

    Choices: as `pycolmap.bundle_adjustment`, which would write COLMAP's own lines to stderr, from
      then on all of them, whatever the level of its log is.
    """
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = pycolmap.BundleAdjustmentConfig()
    for identity in model.reg_image_ids():
        config.add_image(identity)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _bundle_near(
    model: pycolmap.Reconstruction,
    images: list[pycolmap.Image],
    sensor_poses: np.ndarray,
    options: pycolmap.BundleAdjustmentOptions,
    spread: float,
) -> None:
    """Bundle adjustment with the sensor's centres as priors, of standard deviation `spread`."""
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    for image, place in zip(images, centers(sensor_poses), strict=True):
        config.add_image(image.image_id)
        prior = pycolmap.PosePrior()
        prior.corr_data_id, prior.position = image.data_id, place
        prior.position_covariance = np.eye(3) * max(spread, 1e-9) ** 2
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    pycolmap.create_pose_prior_bundle_adjuster(
        options, prior_options, config, priors, model
    ).solve()
