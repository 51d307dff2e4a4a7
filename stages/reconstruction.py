"""Structure from motion by pycolmap: triangulation of known poses, or full reconstruction."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import pycolmap

    from chebsplat.formats.capture import Capture
    from chebsplat.stages.settings import SfmSection

log = logging.getLogger("chebsplat")


def reconstruct(job: Job, capture: Capture, settings: SfmSection) -> dict[str, Any]:
    """Match all views, then triangulate (poses given) or map incrementally (none given).

    Returns: names, Ks, cam_from_world of the registered views; means, colors, seen_from, tracks; notes.
    Raises:  DataFailure if too few views register.
    Choices: images are imported in the order of their names before extraction, which makes extraction, matching and
      triangulation reproducible; mapping is reproducible at one thread only, which it gets. Test views take part in
      posing, never in colouring.
    """
    import pycolmap

    job.scratch.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value if hasattr(pycolmap.logging, "ERROR") else 2
    database = _match(job, capture, settings)
    posed = capture.cam_from_world is not None
    model = _triangulate(job, capture, database) if posed else _map(job, database, settings)
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    names = [name for name in capture.names if f"{name}.png" in by_name]
    if len(names) < max(settings.min_registered * len(capture.names), 2):
        raise DataFailure(
            f"{len(names)} of {len(capture.names)} views registered; at least "
            f"{settings.min_registered:.0%} are needed (sfm.min_registered); add views with more overlap"
        )
    for name in sorted(set(capture.names) - set(names)):
        log.warning("view %s did not register and is left out", name)
    notes = {"n_registered": len(names), "n_given": len(capture.names)}
    return _collect(model, capture, names, by_name, settings) | {"names": names, "notes": _notes(model, posed) | notes}


def _match(job: Job, capture: Capture, settings: SfmSection) -> Path:
    """Extract SIFT from the capture's own pixels and match every pair."""
    import numpy as np
    import pycolmap
    from PIL import Image

    folder, database = job.scratch / "images", job.scratch / "database.db"
    folder.mkdir(exist_ok=True)
    database.unlink(missing_ok=True)
    for view, name in enumerate(capture.names):
        file = folder / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(capture.images[view]).save(file)
        if capture.loss_mask is not None:
            mask = job.scratch / "masks" / f"{name}.png.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.where(capture.loss_mask[view], 255, 0).astype(np.uint8)).save(mask)
    pycolmap.Database.open(database).close()  # creates it
    files = sorted(f"{name}.png" for name in capture.names)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    if capture.loss_mask is not None:
        reader.mask_path = str(job.scratch / "masks")
    mode = pycolmap.CameraMode.PER_IMAGE if _cameras_differ(capture) else pycolmap.CameraMode.SINGLE
    if not _cameras_differ(capture):
        K = capture.Ks[0]
        reader.camera_params = ",".join(str(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    pycolmap.import_images(database, folder, mode, image_names=files, options=reader)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.peak_threshold = settings.peak_threshold
    extraction.use_gpu = False
    log.info("extracting features of %d views", len(files))
    pycolmap.extract_features(database, folder, files, mode, reader, extraction)
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    log.info("matching all pairs")
    pycolmap.match_exhaustive(database, matching)
    return database


def _cameras_differ(capture: Capture) -> bool:
    import numpy as np

    return not np.allclose(capture.Ks, capture.Ks[:1])


def _triangulate(job: Job, capture: Capture, database: Path) -> pycolmap.Reconstruction:
    """Points of known cameras; poses and intrinsics are kept as given."""
    import pycolmap

    assert capture.cam_from_world is not None
    model = pycolmap.Reconstruction()
    position = {f"{name}.png": view for view, name in enumerate(capture.names)}
    width, height = capture.size
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
    for image in sorted(images, key=lambda image: image.image_id):
        view = position[image.name]
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


def _map(job: Job, database: Path, settings: SfmSection) -> pycolmap.Reconstruction:
    """The largest of the models that incremental mapping finds."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = settings.seed
    out = job.scratch / "mapped"
    out.mkdir(exist_ok=True)
    log.info("estimating poses")
    models = pycolmap.incremental_mapping(database, job.scratch / "images", out, options)
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
    model: pycolmap.Reconstruction, capture: Capture, names: list[str], by_name: dict[str, Any], settings: SfmSection
) -> dict[str, Any]:
    """Arrays of the model: cameras by name, points with a training view that sees them, colours from such views.

    Choices: points with a reprojection error above 4 px or seen only by test views are dropped; of too many, those
    with the longest tracks stay.
    """
    import numpy as np

    row = {by_name[f"{name}.png"].image_id: index for index, name in enumerate(names)}
    is_test = np.array([capture.is_test[capture.names.index(name)] for name in names])
    cameras = [model.cameras[by_name[f"{name}.png"].camera_id] for name in names]
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3] = [by_name[f"{name}.png"].cam_from_world().matrix() for name in names]
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
        image = capture.images[capture.names.index(names[view])]
        for index in indices:
            _, keypoint, image_id = entries[index][2]
            x, y = model.images[image_id].points2D[keypoint].xy
            colors[index] = image[min(int(y), image.shape[0] - 1), min(int(x), image.shape[1] - 1)]
    tracks = [(index, element[0]) for index, entry in enumerate(entries) for element in entry[1]]
    return {
        "Ks": np.stack([camera.calibration_matrix() for camera in cameras]),
        "cam_from_world": poses,
        "means": np.array([entry[0] for entry in entries]).reshape(-1, 3),
        "colors": colors,
        "seen_from": np.array([entry[2][0] for entry in entries], np.int64),
        "tracks": np.array(tracks, np.int32).reshape(-1, 2),
    }
