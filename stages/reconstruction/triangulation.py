"""Triangulation by pycolmap: points of views with poses, adjusted where these miss the photos."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from chebsplat.errors import ConfigError
from chebsplat.formats.capture import Capture
from chebsplat.stages.reconstruction import matching
from chebsplat.stages.reconstruction.adjustment import adjust
from chebsplat.stages.reconstruction.pose_check import wants_adjustment, wants_lines
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import SfmSection
from chebsplat.stages.sources.common import file_of

log = logging.getLogger("chebsplat")


def reconstruct(
    job: Job, capture: Capture, settings: SfmSection, most: int, adjusted: bool | None = None
) -> dict[str, Any]:
    """Match views, then triangulate their points.

    Args:    most: points; adjusted: true to adjust the poses to the photos; None: where matches
      miss them.
    Returns: names, Ks, cam_from_world; means, colors, seen_from, tracks; notes.
    Raises:  ConfigError where the capture has no poses.
    Choices: images are imported in the order of their names before extraction, which makes
      extraction, matching and triangulation reproducible. Test views take part in posing, never in
      colouring. Where the poses fit the photos, views are matched along epipolar lines alone.
    """
    if capture.cam_from_world is None:
        raise ConfigError(
            "the capture has no poses; give the artifact of stage pose to ingest (--in-model)"
        )
    n = len(capture.names)
    database = matching.with_features(job, capture, settings, range(n))
    pairs = matching.chosen_pairs(job, database, n, settings, capture.cam_from_world)
    if not adjusted and wants_lines(job, capture, settings, database, pairs):
        matching.match_along_lines(job, database, pairs, capture)
        adjusted = False
    else:
        matching.match_freely(job, database, pairs, settings)
    model = _triangulate(job, capture, database)
    moved: dict[str, Any] = {}
    if wants_adjustment(job, capture, settings, database) if adjusted is None else adjusted:
        model, moved = adjust(
            job, model, database, [file_of(view) for view in range(n)], capture.cam_from_world
        )
    else:
        job.left_out("pose estimation", "poses are given: points are triangulated")
    images = {image.name: image for image in model.images.values()}
    notes = {
        "how": "triangulation",
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "track_length": round(float(model.compute_mean_track_length()), 2),
    }
    log.info(
        "%.2f px, %d points in %.1f views each",
        notes["reprojection_error_px"], model.num_points3D(), notes["track_length"],
    )  # fmt: skip
    cloud = _collect(model, capture, [images[file_of(view)] for view in range(n)], most)
    return cloud | {"notes": notes | moved}


def _triangulate(job: Job, capture: Capture, database: Path) -> pycolmap.Reconstruction:
    """Points under the capture's poses and intrinsics, which stay fixed."""
    assert capture.cam_from_world is not None
    model = pycolmap.Reconstruction()
    width, height = capture.size
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
    for image in sorted(images, key=lambda image: image.image_id):
        view = int(image.name[:-4])
        K = capture.Ks[view]
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera = pycolmap.Camera(
            model="PINHOLE", width=width, height=height, params=params, camera_id=image.camera_id
        )
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


def _collect(
    model: pycolmap.Reconstruction,
    capture: Capture,
    images: list[pycolmap.Image],
    most: int,
) -> dict[str, Any]:
    """Arrays of the model: cameras, points that a training view sees, and colours from such views.

    Choices: points with a reprojection error above 4 px or seen only by test views are dropped; of
      too many, those with the longest tracks stay.
    """
    row = {image.image_id: index for index, image in enumerate(images)}
    cameras = [model.cameras[image.camera_id] for image in images]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    entries = []
    for identity in sorted(model.points3D):
        point = model.points3D[identity]
        elements = [
            (row[e.image_id], e.point2D_idx, e.image_id)
            for e in point.track.elements
            if e.image_id in row
        ]
        training = [e for e in elements if not capture.is_test[e[0]]]
        if training and point.error <= 4:
            entries.append((point.xyz, elements, training[0]))
    entries.sort(key=lambda entry: -len(entry[1]))
    entries = entries[:most]
    colors = np.zeros((len(entries), 3), np.uint8)
    by_view: dict[int, list[int]] = {}
    for index, (_, _, first) in enumerate(entries):
        by_view.setdefault(first[0], []).append(index)
    for view, indices in by_view.items():
        image = capture.images[view]
        for index in indices:
            _, keypoint, image_id = entries[index][2]
            x, y = model.images[image_id].points2D[keypoint].xy
            colors[index] = image[min(int(y), image.shape[0] - 1), min(int(x), image.shape[1] - 1)]
    tracks = [(index, element[0]) for index, entry in enumerate(entries) for element in entry[1]]
    return {
        "names": list(capture.names),
        "Ks": np.stack([camera.calibration_matrix() for camera in cameras]),
        "cam_from_world": poses,
        "means": np.array([entry[0] for entry in entries]).reshape(-1, 3),
        "colors": colors,
        "seen_from": np.array([entry[2][0] for entry in entries], np.int64),
        "tracks": np.array(tracks, np.int32).reshape(-1, 2),
    }
