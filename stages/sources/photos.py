"""The photos source: a folder of images and nothing else. Poses come from structure from motion.

The lens of photos that come without a camera, focal length and distortion, is estimated from some of the photos.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.stages.runtime.command import n_threads
from chebsplat.stages.sources import assembly, cameras, common
from chebsplat.stages.sources.cameras import Camera, fault
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.pictures import open_photo

GUESS = 1.2  # focal length in longer sides, where EXIF says nothing
FILM = 36.0  # mm, the longer side of the frame that 35 mm equivalents refer to
log = logging.getLogger("chebsplat")
VIEWS, LEAST = 16, 8  # photos that the lens is estimated from: at most, and at least
SIDE, SMALLEST = 1000, 320  # pixels of the longer side: what photos are reduced to, and under which none is looked at
FEATURES = 2048  # of a photo: the largest ones
REGISTERED = 0.75  # part of the photos that must register
SEEN = 0.5  # pixels, of SIDE, that a corner is moved by; a lens that moves it less counts as straight
STRONGEST = 0.4  # |k|: beyond it the estimate is none of a lens, but of a wrong model


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture, without poses. `class_names` is of no use here: photos have no labels.

    Choices: structure from motion works on the views that are made here, so that what a lens bends is undone before.
    """
    listing = _listing(folder)
    if settings.lens == "estimated":
        used, notes = assembly.chosen(listing, settings)
        listing.frames, note = with_lens(used, listing.upright)
        listing.notes = [*notes, *([note] if note else [])]
    return assembly.assemble(listing, settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """What a folder of photos brings beside them: nothing."""
    return {"poses": False, "depth": False, "labels": False}


def files(folder: Path) -> list[Path]:
    """The photos and their masks. Raises InputError if there are no photos."""
    place, names = _photos(folder)
    masks = common.names_below(folder / "masks")
    return sorted([*(place / name for name in names), *(folder / "masks" / name for name in masks)])


def _photos(folder: Path) -> tuple[Path, list[str]]:
    """The folder of the photos, and their paths below it: those that lie in it; otherwise in images/ or the like;
    otherwise in its subfolders, one for each camera. Raises InputError if there are none.
    """
    try:
        names = [name for name in os.listdir(folder) if is_image(name)]
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; correct source.path") from None
    place = folder
    if not names:
        place = common.photo_folder(folder)
        names = list(common.names_below(place))
    if not names:
        place, inner = folder, [name for name in common.with_photos(folder) if name not in common.BESIDE]
        names = [f"{name}/{file}" for name in inner for file in common.names_below(folder / name)]
    if not names:
        raise InputError(f"{folder} holds no .jpg, .png or .heic image; correct source.path")
    return place, sorted(common.printable(place, names))


def _listing(folder: Path) -> Listing:
    frames, guessed = [], 0
    place, names = _photos(folder)
    masks, notes = common.masks_in(folder, names)
    for name in names:
        path = place / name
        (width, height), focal = header(path)
        guessed += focal is None
        pixels = max(width, height) * (GUESS if focal is None else focal / FILM)
        camera = cameras.camera_of(path, "SIMPLE_PINHOLE", (pixels, width / 2, height / 2), width, height)
        frames.append(Frame(common.stem(name), path, camera, mask=masks.get(name)))
    if guessed:
        notes.append(
            f"{guessed} of {len(frames)} photos have no focal length; {GUESS} times the longer side is the first guess."
        )
    used = {place.name, *(name.partition("/")[0] for name in names)}
    if beside := set(common.with_photos(folder)) - used:
        notes.append(f"Photos in these folders are not read: {', '.join(sorted(beside, key=common.natural))}.")
    return Listing("photos", frames, notes=notes, upright=True)


class Lens(NamedTuple):
    """focal: in longer sides of the photo; k: of COLMAP's SIMPLE_RADIAL, r' = r (1 + k r²); error: pixels of SIDE."""

    focal: float
    k: float
    error: float


def with_lens(frames: list[Frame], upright: bool) -> tuple[list[Frame], str]:
    """Frames whose cameras have the lens that most photos were taken with, and a note; as they are where none is found.

    Choices: photos of equal sides, either way up, and of equal focal length in their EXIF have one lens. The lens is
      estimated by mapping a run of VIEWS of them, in the order of their names, which overlap.
    """
    kinds = Counter(_kind(frame.camera) for frame in frames)
    kind, _ = kinds.most_common(1)[0]
    shapes = Counter((frame.camera.width, frame.camera.height) for frame in frames if _kind(frame.camera) == kind)
    width, height = shapes.most_common(1)[0][0]
    alike = [f for f in frames if _kind(f.camera) == kind and (f.camera.width, f.camera.height) == (width, height)]
    if len(alike) < LEAST or max(width, height) < SMALLEST:
        return frames, ""
    first = (len(alike) - min(len(alike), VIEWS)) // 2
    lens = estimate(alike[first : first + VIEWS], upright)
    if lens is None:
        return frames, "The lens could not be estimated from the photos; their distortion stays."
    shift = corner_shift(lens, width, height)
    measured = f"{lens.focal:.3f} times the longer side, k = {lens.k:+.4f}"
    if shift < SEEN:
        return frames, f"The lens is straight ({measured}: corners move by {shift:.2f} of {SIDE} pixels)."
    return [
        replace(frame, camera=_bent(frame.camera, lens)) if _kind(frame.camera) == kind else frame for frame in frames
    ], (
        f"The lens bends {kinds[kind]} of {len(frames)} photos: focal length {measured}; "
        f"corners move by {shift:.1f} of {SIDE} pixels, which is undone."
    )


def corner_shift(lens: Lens, width: int, height: int) -> float:
    """Pixels that the corner of a photo of this shape moves by, were its longer side SIDE."""
    longer = max(width, height)
    radius = (width**2 + height**2) ** 0.5 / longer / 2  # longer sides
    return abs(lens.k) * radius**3 / lens.focal**2 * SIDE


def estimate(frames: list[Frame], upright: bool, seed: int = 0) -> Lens | None:
    """The lens of photos of one camera: all matched with each other, and mapped with one SIMPLE_RADIAL camera.

    Returns: None where few register, or the estimate is none of a lens.
    Choices: the principal point is the photo's middle. Mapping has one thread, and repeats.
    """
    import pycolmap

    camera = frames[0].camera
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    size = (round(camera.width * scale), round(camera.height * scale))
    log.info("estimating the lens from %d photos at %d x %d", len(frames), *size)
    pycolmap.logging.minloglevel = 2  # errors
    with tempfile.TemporaryDirectory(prefix="chebsplat-lens-") as place:
        folder, database = Path(place) / "images", Path(place) / "database.db"
        folder.mkdir()
        names = [f"{k:03d}.png" for k in range(len(frames))]
        for frame, name in zip(frames, names, strict=True):
            _reduced(frame, upright, size, folder / name)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        reader.camera_params = f"{camera.pinhole[0] * scale},{size[0] / 2},{size[1] / 2},0"
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.sift.max_num_features = FEATURES
        extraction.use_gpu, extraction.num_threads = False, n_threads()
        pycolmap.Database.open(database).close()  # creates it
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, folder, mode, image_names=names, options=reader)
        pycolmap.extract_features(database, folder, names, mode, reader, extraction)
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.use_gpu, matching.num_threads = False, n_threads()
        verification.ransac.random_seed = seed
        pycolmap.match_exhaustive(database, matching, verification_options=verification)
        mapping = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads, mapping.random_seed = 1, seed
        (Path(place) / "mapped").mkdir()
        models = pycolmap.incremental_mapping(database, folder, Path(place) / "mapped", mapping)
    model = max(models.values(), key=lambda found: found.num_reg_images(), default=None)
    if model is None or model.num_reg_images() < max(REGISTERED * len(frames), LEAST):
        return None
    focal, _, _, k = next(iter(model.cameras.values())).params
    lens = Lens(float(focal) / max(size), float(k), float(model.compute_mean_reprojection_error()))
    return lens if abs(lens.k) <= STRONGEST and not fault(_bent(camera, lens)) else None


def _kind(camera: Camera) -> tuple[int, int, float]:
    return min(camera.width, camera.height), max(camera.width, camera.height), camera.pinhole[0]


def _bent(camera: Camera, lens: Lens) -> Camera:
    focal = lens.focal * max(camera.width, camera.height)
    return Camera("SIMPLE_RADIAL", (focal, camera.width / 2, camera.height / 2, lens.k), camera.width, camera.height)


def _reduced(frame: Frame, upright: bool, size: tuple[int, int], path: Path) -> None:
    with open_photo(frame.image, (frame.camera.width, frame.camera.height), upright) as (image, _):
        image.resize(size, Image.Resampling.BOX).save(path, compress_level=1)
