"""Cameras of photos that come alone, by pycolmap's incremental mapping, which calibrates them, too.

Where the usual features and lens fail, more features are tried, and a fisheye's lens.
"""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.reconstruction import judge
from chebsplat.stages.reconstruction.adjustment import bundle_all
from chebsplat.stages.reconstruction.matching import (
    chosen_pairs,
    empty_database,
    extract,
    match_freely,
)
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import PoseSection
from chebsplat.stages.sources.cameras import EQUIRECTANGULAR
from chebsplat.stages.sources.common import Shot, file_of

log = logging.getLogger("chebsplat")
MORE = 1.1  # times the photos of the best so far, that a costlier attempt must register
HALF = 0.5  # of the photos: if fewer register, mapping starts from a smaller angle, then as fisheye
FISHEYE = "OPENCV_FISHEYE"
FAINT = 0.002  # SIFT's peak threshold where the usual one finds too little; it costs exactness
WIDE = 0.5  # a fisheye's focal length in longer sides, without EXIF
FILM = 36.0  # mm, the longer side of the frame that 35 mm equivalents refer to
STRAY = 3.0  # pixels of the pictures that photos are reduced to
FLATTEST = 1.5  # degrees between the rays of a point: COLMAP's own
# degrees between the rays of the pair that mapping begins with: COLMAP's own, and where it fails
INIT_ANGLES = 16.0, 2.0
# Photos have focal lengths of their own where the middle 80 % of these span more than ONE_LENS, in
# ln, and lower the reprojection error to CLEARER. Rooms rendered through one lens span .01, and the
# error stays; through a zoom that goes by 5 % .03, to .94, and cameras lie 1 to 2 cm nearer. Of
# three real captures one spans .026, to .97.
ONE_LENS, CLEARER = 0.02, 0.96
KEPT = 0.98  # of the observations, which stay at least
WILD = 0.7  # in ln: where the focal length of any photo differs by more, none has its own
# distortion terms of camera models
LENSES = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 1, "OPENCV": 4, "OPENCV_FISHEYE": 4}


def map_photos(
    job: Job, shots: Sequence[Shot], pictures: Path, settings: PoseSection
) -> PhotoModel | None:
    """The model of photos whose reduced pictures lie in a folder, named by their rows; None where
    no two register.

    Choices: attempts end once none could register MORE times the photos of the best; a costlier one
      replaces it only with MORE times its undisputed photos, for faint features also match
      look-alikes. Mapping runs on one thread, to be repeatable.
    """

    def mapped(lens: str, peak: float) -> PhotoModel | None:
        database = _matched(
            job, shots, pictures, lens, settings.model_copy(update={"peak_threshold": peak})
        )
        return _mapped(job, shots, pictures, database, settings)

    lens: str = settings.camera
    if lens == "auto":
        lens = EQUIRECTANGULAR if all(shot.panorama for shot in shots) else "SIMPLE_RADIAL"
    best = mapped(lens, settings.peak_threshold)
    for other, peak in further(lens, settings, 0 if best is None else len(best.names) / len(shots)):
        n_registered = 0 if best is None else len(best.names)
        if n_registered * MORE >= len(shots):
            break
        log.info(
            "%d of %d photos registered; trying %s, features from %g on",
            n_registered,
            len(shots),
            other,
            peak,
        )
        tried = mapped(other, peak)
        undisputed = 0 if best is None else best.judged["n_undisputed"]
        if tried is not None and tried.judged["n_undisputed"] > MORE * undisputed:
            best = tried
    return best


def further(lens: str, settings: PoseSection, registered: float) -> list[tuple[str, float]]:
    """(camera model, peak threshold of SIFT) to try after `lens` has registered such a part of the
    photos: more features, and first a fisheye's lens where it is less than HALF.
    """
    faint = min(settings.peak_threshold, FAINT)
    fisheye = settings.camera == "auto" and lens != EQUIRECTANGULAR and registered < HALF
    return [(FISHEYE, faint)] * fisheye + [(lens, faint)] * (faint < settings.peak_threshold)


def _matched(
    job: Job, shots: Sequence[Shot], pictures: Path, lens: str, settings: PoseSection
) -> Path:
    """A database of the photos' features and matches.

    Choices: photos of one size and focal length have one camera. Without a focal length in EXIF
      mapping finds it, but for a fisheye's, which needs a guess.
    """
    database = empty_database(job.scratch / "database.db")
    alike: dict[tuple[tuple[int, int], float | None, bool], list[int]] = {}
    for row, shot in enumerate(shots):
        alike.setdefault((shot.size, shot.focal, shot.panorama), []).append(row)
    named = lens
    for (_, focal, panorama), rows in alike.items():
        lens = EQUIRECTANGULAR if panorama and settings.camera == "auto" else named
        width, height = shots[rows[0]].reduced(settings.max_side)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = lens
        if lens == EQUIRECTANGULAR:
            reader.camera_params = f"{width},{height}"
        elif focal is not None or lens == FISHEYE:
            pixels = max(width, height) * (WIDE if focal is None else focal / FILM)
            focals = [pixels] * (2 if lens.startswith("OPENCV") else 1)
            reader.camera_params = ",".join(
                map(str, [*focals, width / 2, height / 2, *[0.0] * LENSES[lens]])
            )
        if any(shot.mask for shot in shots):
            reader.mask_path = str(pictures / "masks")
        files = [file_of(row) for row in rows]
        extract(job, database, pictures, files, reader, pycolmap.CameraMode.SINGLE, settings)
    match_freely(job, database, chosen_pairs(job, database, len(shots), settings), settings)
    return database


def _mapped(
    job: Job, shots: Sequence[Shot], pictures: Path, database: Path, settings: PoseSection
) -> PhotoModel | None:
    """The largest model that mapping finds, in pixels of the photos; None where there is none."""
    models = _joined(job, len(shots), pictures, database, settings)
    if not models:
        return None
    model, *others = models
    misplaced = judge.misplaced(judge.pairs(model, database))
    for identity in misplaced:
        model.deregister_frame(model.images[identity].frame_id)
    mapped_error = model.compute_mean_reprojection_error()
    if settings.camera == "auto":
        _free_second_term(model)
    _refine(model)
    own = _with_own_focals(model)
    ratios = _focal_ratios(own, model)
    sane = np.abs(ratios) < WILD
    low, high = np.quantile(ratios[sane], (0.1, 0.9)) if sane.any() else (0.0, 0.0)
    if high - low > ONE_LENS and sane.all() and _fits_better(own, model):
        model = own
    sizes = [other.num_reg_images() for other in others]
    judged = judge.judge_model(
        model,
        judge.pairs(model, database),
        len(shots),
        sizes,
        len(misplaced),
        mapped_error,
        float(high - low),
        model is own,
    )
    return _collected(model, shots, judged)


def _joined(
    job: Job, n_photos: int, pictures: Path, database: Path, settings: PoseSection
) -> list[pycolmap.Reconstruction]:
    """The models that mapping finds, largest first.

    Choices: without pairs of photos that may join two parts of the largest wrongly it is mapped
      again, which counts where more of all pairs then agree.
    """
    models: list[pycolmap.Reconstruction] = []
    most, rest = -1, database
    tried = _models(job, n_photos, pictures, database, settings)
    while tried and (graph := judge.pairs(tried[0], database, judge.FEW)).n_agree > most:
        models, most = tried, graph.n_agree
        joint = judge.joint(graph)
        if not joint:
            break
        log.info("%d pairs of photos may join two parts wrongly; mapping without them", len(joint))
        if rest == database:
            rest = job.scratch / "rest.db"
            shutil.copy(database, rest)
        with pycolmap.Database.open(rest) as opened:
            for pair in joint:
                opened.delete_two_view_geometry(*pair)
        tried = _models(job, n_photos, pictures, rest, settings)
    return models


def _models(
    job: Job, n_photos: int, pictures: Path, database: Path, settings: PoseSection
) -> list[pycolmap.Reconstruction]:
    """The models that mapping finds by a database, largest first.

    Choices: where fewer than HALF of the photos register, it begins again with a smaller angle
      between the rays of its first pair, which counts where more pairs of photos then agree. If no
      pair has an angle, COLMAP itself tries a half and a quarter of it, which is not enough for
      handheld photos of one side of a thing.
    """
    best: list[pycolmap.Reconstruction] = []
    most = -1
    for angle in INIT_ANGLES:
        n_registered = best[0].num_reg_images() if best else 0
        if n_registered >= HALF * n_photos:
            break
        if angle != INIT_ANGLES[0]:
            log.info(
                "%d of %d photos registered; mapping again, from pairs of a smaller angle",
                n_registered,
                n_photos,
            )
        tried = _models_from(angle, job, n_photos, pictures, database, settings)
        if tried and (agreeing := judge.pairs(tried[0], database, judge.FEW).n_agree) > most:
            best, most = tried, agreeing
    return best


def _models_from(
    init_angle: float,
    job: Job,
    n_photos: int,
    pictures: Path,
    database: Path,
    settings: PoseSection,
) -> list[pycolmap.Reconstruction]:
    """As `_models`, beginning with pairs of such an angle, degrees."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, settings.seed
    options.mapper.init_min_tri_angle = init_angle
    out = job.scratch / "mapped"
    out.mkdir(exist_ok=True)
    with job.progress.ticker(n_photos, "poses") as registered:

        def first_pair() -> None:
            registered()
            registered()

        models = pycolmap.incremental_mapping(
            database, pictures, out, options,
            initial_image_pair_callback=first_pair, next_image_callback=registered,
        )  # fmt: skip
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)


def _free_second_term(model: pycolmap.Reconstruction) -> None:
    """Let r⁴ bend the lens, too, once poses are near: SIMPLE_RADIAL becomes RADIAL.

    Choices: against the truth of rendered rooms through lenses with both terms, rotations miss by
      .06 to .19° instead of .13 to .80, centres by .3 to .9 cm instead of .4 to 4.7. While photos
      are still being placed, one term is the safer guess. OPENCV's tangential terms help nothing.
    """
    for camera in model.cameras.values():
        if camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
            one_term = camera.params
            camera.model = pycolmap.CameraModelId.RADIAL
            camera.params = [*one_term, 0.0]


def _refine(model: pycolmap.Reconstruction) -> None:
    """Adjust a model's cameras, poses and points once more, without outlying observations.

    Choices: under a Cauchy loss of one pixel, then without those that miss by more than STRAY, and
      again. On views of a modelled house, against true poses, it reduces the error of rotations
      from .43 to .30° and of centres from 1.9 to 1.7 cm.
    """
    for _ in range(2):
        bundle_all(model, _adjusting())
        pycolmap.ObservationManager(model).filter_all_points3D(STRAY, FLATTEST)
    model.update_point_3d_errors()


def _adjusting() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    # of 0 it takes five times as long for the same cameras
    options.ceres.solver_options.function_tolerance = 1e-5
    return options


def _with_own_focals(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy of a model, adjusted, in which each photo has a camera of its own: its focal length is
    free, its distortion the model's.

    Choices: one focal length for all hides a zoom that moves, or a focus: poses make up for it, by
      centimetres, and points still fit.
    """
    own = pycolmap.Reconstruction()
    for identity, image in model.images.items():
        if image.has_pose:
            camera = copy(model.cameras[image.camera_id])
            camera.camera_id = identity
            own.add_camera_with_trivial_rig(camera)
            places = np.array([point.xy for point in image.points2D])
            photo = pycolmap.Image(image.name, places, camera_id=identity, image_id=identity)
            own.add_image_with_trivial_frame(photo, image.cam_from_world())
    for point in model.points3D.values():
        own.add_point3D(point.xyz, point.track, point.color)
    options = _adjusting()
    options.refine_extra_params = False
    bundle_all(own, options)
    pycolmap.ObservationManager(own).filter_all_points3D(STRAY, FLATTEST)
    own.update_point_3d_errors()
    return own


def _focal_ratios(own: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> np.ndarray:
    """ln of the ratio of each photo's own focal length to the model's; [0] where none has one, as
    photos of all directions.
    """
    pairs = [
        (own.cameras[identity], model.cameras[model.images[identity].camera_id])
        for identity, image in own.images.items()
        if image.has_pose
    ]
    ratios = [
        max(camera.mean_focal_length() / shared.mean_focal_length(), 1e-9)
        for camera, shared in pairs
        if shared.focal_length_idxs()
    ]
    return np.array([math.log(ratio) for ratio in ratios or [1.0]])


def _fits_better(own: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> bool:
    """True where own focal lengths lower the error to CLEARER, and not by losing observations."""
    most = CLEARER * model.compute_mean_reprojection_error()
    kept = own.compute_num_observations() > KEPT * model.compute_num_observations()
    return bool(kept and own.compute_mean_reprojection_error() < most)


def _collected(
    model: pycolmap.Reconstruction, shots: Sequence[Shot], judged: dict[str, Any]
) -> PhotoModel:
    """The arrays of a model, its cameras in pixels of the photos as they are."""
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)
    rows = [int(image.name[:-4]) for image in images]
    used = sorted({image.camera_id for image in images})
    place = {image.image_id: view for view, image in enumerate(images)}
    cameras: list[list[Any]] = []
    for identity in used:
        camera, width, height = (
            model.cameras[identity],
            *shots[rows[[i.camera_id for i in images].index(identity)]].size,
        )
        camera.rescale(width, height)
        cameras.append(
            [camera.model.name, [float(value) for value in camera.params], width, height]
        )
    points: list[Any] = [model.points3D[key] for key in sorted(model.points3D)]
    tracks = [
        (k, place[e.image_id])
        for k, p in enumerate(points)
        for e in p.track.elements
        if e.image_id in place
    ]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    lenses = ", ".join(
        f"{name} {[round(value, 4) for value in params]}" for name, params, *_ in cameras[:3]
    )
    more = "" if len(cameras) <= 3 else f", and {len(cameras) - 3} more"
    return PhotoModel(
        [shots[row].name for row in rows],
        cameras,
        np.array([used.index(image.camera_id) for image in images], np.int32),
        poses,
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.error for point in points]),
        np.array(sorted(set(tracks)), np.int32).reshape(-1, 2),
        [shots[row].frame for row in rows],
        [
            judge.sentence(judged),
            f"{len(cameras)} camera{'s' if len(cameras) > 1 else ''} in pixels: {lenses}{more}.",
        ],
        judged,
    )
