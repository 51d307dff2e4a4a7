"""The photos source: a folder of images alone. Cameras and poses come from the stage `pose`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.images import header, is_image, opened
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import IngestSection, PoseSection
from chebsplat.stages.sources import assembly, cameras, common
from chebsplat.stages.sources.colmap import points_of
from chebsplat.stages.sources.colmap_model import Cloud
from chebsplat.stages.sources.common import Frame, Listing, Shot, file_of
from chebsplat.stages.sources.pictures import DEEP, open_photo

SEAM = 3.0  # times the difference of neighbouring columns, above that of a panorama's two ends


def read(folder: Path, settings: IngestSection, model: PhotoModel) -> dict[str, Any]:
    """The fields of a capture: the photos of a model, undistorted, and its points."""
    shots = {shot.name: shot for shot in _listed(folder)[0]}
    if absent := [name for name in model.names if name not in shots]:
        raise InputError(
            f"{folder} has no photo {absent[0]}, which the model has; restore it, or run pose again"
        )
    frames = []
    for view, name in enumerate(model.names):
        camera = cameras.camera_of(shots[name].path, *model.cameras[model.camera[view]])
        frames.append(
            Frame(name, shots[name].path, camera, model.cam_from_world[view], mask=shots[name].mask)
        )
    listing = Listing("photos", frames, notes=list(model.notes), upright=True)
    fields = assembly.assemble(listing, settings)
    lost = assembly.in_empty_space(model.points, fields, listing)
    return fields | points_of(
        Cloud(model.points, model.colors, model.errors, model.tracks), model.names, fields, lost
    )


def probe(folder: Path) -> dict[str, bool]:
    """A folder of photos has neither poses, depth nor labels."""
    return {"poses": False, "depth": False, "labels": False}


def files(folder: Path) -> list[Path]:
    """The photos and their masks. Raises InputError if there are no photos."""
    place, names = _photos(folder)
    masks = common.names_below(folder / "masks")
    return sorted([*(place / name for name in names), *(folder / "masks" / name for name in masks)])


def _photos(folder: Path) -> tuple[Path, list[str]]:
    """The folder of the photos, and their paths below it: directly in it, else in images/ or the
    like, else in its subfolders, one for each camera. Raises InputError if there are none.
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
        place = folder
        inner = [name for name in common.with_photos(folder) if name not in common.BESIDE]
        names = [f"{name}/{file}" for name in inner for file in common.names_below(folder / name)]
    if not names:
        raise InputError(f"{folder} holds no .jpg, .png or .heic image; correct source.path")
    return place, sorted(common.printable(place, names))


def shots(
    folder: Path, settings: PoseSection, reporter: Progress | None, finer: int
) -> tuple[list[Shot], list[str]]:
    """The photos of a folder, at most `max_views` of them, evenly chosen, and notes about them."""
    listed, notes = _listed(folder)
    first: dict[str, Shot] = {}
    for shot in listed:
        first.setdefault(sha256_file(shot.path), shot)
    if len(first) < len(listed):
        notes.append(
            f"{len(listed) - len(first)} of {len(listed)} photos are copies of others, and left "
            "out."
        )
        listed = list(first.values())
    if settings.max_views is not None and len(listed) > settings.max_views:
        rows = np.linspace(0, len(listed) - 1, settings.max_views).round().astype(int)
        notes.append(f"{len(rows)} of {len(listed)} photos are used (pose.max_views).")
        listed = [listed[row] for row in rows]
    if n := sum(shot.focal is None and not shot.panorama for shot in listed):
        notes.append(
            f"{n} of {len(listed)} photos have no focal length; it is found with the poses."
        )
    return listed, notes


def save(photos: Sequence[Shot], _: Path, pictures: Path, max_side: int) -> None:
    """Write photos, reduced until no side exceeds `max_side`, and their masks, for pycolmap."""
    for row, shot in enumerate(photos):
        size = shot.reduced(max_side)
        with open_photo(shot.path, shot.size, upright=True) as (image, _opaque):
            small = image if image.size == size else image.resize(size, Image.Resampling.BOX)
            small.save(pictures / file_of(row), compress_level=1)
        if any(other.mask for other in photos):  # pycolmap then needs one of every photo
            (pictures / "masks").mkdir(exist_ok=True)
            valid = np.full(shot.size[::-1], 255, np.uint8)
            if shot.mask is not None:
                with opened(shot.mask) as mask:
                    valid = np.where(
                        np.asarray(mask.convert("L") if mask.mode not in DEEP else mask) > 0, 255, 0
                    )
            mask = Image.fromarray(valid.astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
            mask.save(pictures / "masks" / f"{file_of(row)}.png")


def _listed(folder: Path) -> tuple[list[Shot], list[str]]:
    place, names = _photos(folder)
    masks, notes = common.masks_in(folder, names)
    listed = []
    for name in names:
        size, focal = header(place / name)
        panorama = focal is None and size[0] == 2 * size[1] and wraps(place / name, size)
        listed.append(Shot(common.stem(name), place / name, size, focal, masks.get(name), panorama))
    used = {place.name, *(name.partition("/")[0] for name in names)}
    if beside := set(common.with_photos(folder)) - used:
        notes.append(
            "Photos in these folders are not read: "
            f"{', '.join(sorted(beside, key=common.natural))}."
        )
    listed.sort(key=lambda shot: common.natural(shot.name))
    common.distinct((shot.name, shot.path) for shot in listed)
    return listed, notes


def wraps(path: Path, size: tuple[int, int]) -> bool:
    """True where a photo's left and right ends match, as those of a panorama do."""
    with open_photo(path, size, upright=True) as (image, _):
        pixels = np.asarray(image.resize((256, 128), Image.Resampling.BOX), np.float32)
    between = np.abs(np.diff(pixels, axis=1)).mean()
    return bool(np.abs(pixels[:, 0] - pixels[:, -1]).mean() < SEAM * max(between, 1.0))
