"""Structure from motion by pycolmap: triangulation of known poses, or full reconstruction."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.formats.capture import Capture
from chebsplat.stages.reconstruction import matching
from chebsplat.stages.reconstruction.adjustment import adjust
from chebsplat.stages.reconstruction.matching import file_of
from chebsplat.stages.reconstruction.pose_check import wants_adjustment, wants_lines
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import SfmSection

log = logging.getLogger("chebsplat")


def reconstruct(job: Job, capture: Capture, settings: SfmSection, adjusted: bool | None = None) -> dict[str, Any]:
    """Match views, then triangulate (poses given) or map incrementally (none given).

    Args:    adjusted: whether given poses are adjusted to the photos; None: as the matches say.
    Returns: names, Ks, cam_from_world of the registered views; means, colors, seen_from, tracks; notes.
    Raises:  DataFailure if too few views register; ConfigError where pairs by pose are asked for without poses.
    Choices: images are imported in the order of their names before extraction, which makes extraction, matching and
      triangulation reproducible; mapping is reproducible at one thread only, which it gets. Test views take part in
      posing, never in colouring. Where given poses fit the photos, matches are looked for along epipolar lines alone.
    """
    posed = capture.cam_from_world is not None
    if settings.matching == "posed" and not posed:
        raise ConfigError("sfm.matching is posed, but the source has no poses; use sfm.matching=auto")
    database = matching.with_features(job, capture, settings, range(len(capture.names)))
    pairs = matching.chosen_pairs(job, database, capture, settings)
    if not adjusted and wants_lines(job, capture, settings, database, pairs):
        matching.match_along_lines(job, database, pairs, capture)
        adjusted = False
    else:
        matching.match_freely(job, database, pairs, settings)
    model = _triangulate(job, capture, database) if posed else _map(job, len(capture.names), database, settings)
    moved: dict[str, Any] = {}
    if wants_adjustment(job, capture, settings, database) if adjusted is None else adjusted:
        names = [file_of(view) for view in range(len(capture.names))]
        model, moved = adjust(job, model, database, names, np.asarray(capture.cam_from_world))
    elif posed:
        job.left_out("pose estimation", "poses are given: points are triangulated")
    registered = {image.name: image for image in model.images.values() if image.has_pose}
    views = [view for view in range(len(capture.names)) if file_of(view) in registered]
    if len(views) < max(settings.min_registered * len(capture.names), 2):
        raise DataFailure(
            f"{len(views)} of {len(capture.names)} views registered; at least "
            f"{settings.min_registered:.0%} are needed (sfm.min_registered); add views with more overlap"
        )
    for view in sorted(set(range(len(capture.names))) - set(views)):
        log.warning("view %s did not register and is left out", capture.names[view])
    notes = _notes(model, posed) | moved | {"n_registered": len(views), "n_given": len(capture.names)}
    log.info(
        "%d of %d registered, %.2f px, %d points in %.1f views each",
        len(views), len(capture.names), notes["reprojection_error_px"], model.num_points3D(), notes["track_length"],
    )  # fmt: skip
    return _collect(model, capture, views, registered, settings) | {"notes": notes}


def _triangulate(job: Job, capture: Capture, database: Path) -> pycolmap.Reconstruction:
    """Points of known cameras; poses and intrinsics are kept as given."""
    assert capture.cam_from_world is not None
    model = pycolmap.Reconstruction()
    width, height = capture.size
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
    for image in sorted(images, key=lambda image: image.image_id):
        view = int(image.name[:-4])
        K = capture.Ks[view]
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=image.camera_id)
        if not model.exists_camera(image.camera_id):
            model.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(capture.cam_from_world[view][:3])
        fresh = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(fresh, pose)
    out = job.scratch / "triangulated"
    out.mkdir(exist_ok=True)
    log.info("triangulating")
    return pycolmap.triangulate_points(
        model, database, job.scratch / "images", out, clear_points=True, refine_intrinsics=False
    )


def _map(job: Job, n_views: int, database: Path, settings: SfmSection) -> pycolmap.Reconstruction:
    """The largest of the models that incremental mapping finds."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = settings.seed
    out = job.scratch / "mapped"
    out.mkdir(exist_ok=True)
    registered = job.progress.ticker(n_views, "poses")

    def first_pair() -> None:
        registered()
        registered()

    models = pycolmap.incremental_mapping(
        database, job.scratch / "images", out, options,
        initial_image_pair_callback=first_pair, next_image_callback=registered,
    )  # fmt: skip
    if not models:
        raise DataFailure("no two views could be registered; add views with more overlap and texture")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _notes(model: pycolmap.Reconstruction, posed: bool) -> dict[str, Any]:
    return {
        "how": "triangulation" if posed else "structure from motion",
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "track_length": round(float(model.compute_mean_track_length()), 2),
    }


def _collect(
    model: pycolmap.Reconstruction, capture: Capture, views: list[int], registered: dict[str, Any], settings: SfmSection
) -> dict[str, Any]:
    """Arrays of the model: registered cameras, points with a training view that sees them, colours from such views.

    Choices: points with a reprojection error above 4 px or seen only by test views are dropped; of too many, those
    with the longest tracks stay.
    """
    images = [registered[file_of(view)] for view in views]
    row = {image.image_id: index for index, image in enumerate(images)}
    is_test = capture.is_test[views]
    cameras = [model.cameras[image.camera_id] for image in images]
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    entries = []
    for identity in sorted(model.points3D):
        point = model.points3D[identity]
        elements = [(row[e.image_id], e.point2D_idx, e.image_id) for e in point.track.elements if e.image_id in row]
        training = [e for e in elements if not is_test[e[0]]]
        if training and point.error <= 4:
            entries.append((point.xyz, elements, training[0]))
    entries.sort(key=lambda entry: -len(entry[1]))
    entries = entries[: settings.max_points]
    colors = np.zeros((len(entries), 3), np.uint8)
    by_view: dict[int, list[int]] = {}
    for index, (_, _, first) in enumerate(entries):
        by_view.setdefault(first[0], []).append(index)
    for view, indices in by_view.items():
        image = capture.images[views[view]]
        for index in indices:
            _, keypoint, image_id = entries[index][2]
            x, y = model.images[image_id].points2D[keypoint].xy
            colors[index] = image[min(int(y), image.shape[0] - 1), min(int(x), image.shape[1] - 1)]
    tracks = [(index, element[0]) for index, entry in enumerate(entries) for element in entry[1]]
    return {
        "names": [capture.names[view] for view in views],
        "Ks": np.stack([camera.calibration_matrix() for camera in cameras]),
        "cam_from_world": poses,
        "means": np.array([entry[0] for entry in entries]).reshape(-1, 3),
        "colors": colors,
        "seen_from": np.array([entry[2][0] for entry in entries], np.int64),
        "tracks": np.array(tracks, np.int32).reshape(-1, 2),
    }
