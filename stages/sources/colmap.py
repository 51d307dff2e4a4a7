"""The COLMAP source: images/ and a model in sparse/0, with depth/, semantic/ and masks/ where they are given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import assembly, cameras, common, texts
from chebsplat.stages.sources.colmap_model import Model, read_model
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.pictures import names_by_id

HELP = "correct source.path; a COLMAP source holds images/ and sparse/0/{cameras,images,points3D}.bin or .txt"
COMPANIONS = {"depth": "depth", "semantic": "labels"}  # folder: what its PNGs are
FEW = 10**6  # more than any test_every
MIN_TRACK = 3  # images that see a point: two can agree by chance
MAX_ERROR = 4.0  # pixels, of a point's mean reprojection error
LEAST = 100  # good points; a model with fewer is one whose points somebody has taken away


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture; `is_test` too, if scene.json says which views are.

    Choices: scene.json's split counts all of its frames, so `max_views` never moves a view from one side to the
      other; if it leaves one side empty, the split is not given and a note says so. The model's points are taken
      unless there is depth, which gives more and is held against them (`landmarks`); of those with tracks the ones
      that fewer than MIN_TRACK images see, or that lie farther than MAX_ERROR pixels off on average, are left out.
    """
    listing, model = _listing(folder)
    fields = assembly.assemble(listing, settings, class_names)
    if "depth" in fields and settings.depth == "auto":
        fields["landmarks"] = _points(model, fields["names"], [])
    else:
        fields |= _points(model, fields["names"], fields["source"]["notes"])
    split = _split(folder, [frame.name for frame in listing.frames])
    if split is not None:
        assembly.give_split(fields, split, "scene.json")
    return fields


def probe(folder: Path) -> dict[str, bool]:
    """Light: reads names only. A folder with PNGs is a promise: `read` fails if a view of the model has none."""
    return {"poses": True} | {
        of: any(name.endswith(".png") for name in common.names_below(folder / place))
        for place, of in COMPANIONS.items()
    }


def files(folder: Path) -> list[Path]:
    """The model, scene.json, labels.json, and every image, depth, label and mask."""
    model = [path for path in _model_folder(folder).iterdir() if path.suffix in (".bin", ".txt")]
    documents = [folder / name for name in ("scene.json", "labels.json") if common.present(folder / name)]
    data = [folder / place / name for place in ("images", *COMPANIONS, "masks")
            for name in common.names_below(folder / place)]  # fmt: skip
    return sorted([*model, *documents, *data])


def _pngs(folder: Path) -> set[str]:
    return {name[:-4] for name in common.names_below(folder) if name.endswith(".png")}


def _model_folder(folder: Path) -> Path:
    for place in ("sparse/0", "sparse"):
        if any(common.present(folder / place / f"cameras.{end}") for end in ("bin", "txt")):
            return folder / place
    raise InputError(f"{folder / 'sparse/0'} holds no COLMAP model (cameras.bin or cameras.txt); {HELP}")


def _document(folder: Path) -> dict[str, Any]:
    path = folder / "scene.json"
    return texts.read_json(path) if common.present(path) else {}


def _split(folder: Path, names: list[str]) -> set[str] | None:
    """Names of the test views: every `test_every`-th frame of scene.json, from its first on; None if it has no say."""
    document = _document(folder)
    if "test_every" not in document:
        return None
    try:
        every = texts.whole(document["test_every"], 2, FEW)
        listed = [common.stem(frame["file"]) for frame in document.get("frames", [])]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / 'scene.json'}: test_every or the frames' files are not usable ({error}); restore it"
        ) from None
    return set((listed or sorted(names, key=common.natural))[::every])


def _label_names(folder: Path) -> dict[int, str] | None:
    """Class names by id, of scene.json's "labels" or of labels.json: {"id": name}."""
    path, document = folder / "scene.json", _document(folder)
    if "labels" in document:
        table = document["labels"]
    elif common.present(path := folder / "labels.json"):
        table = texts.read_json(path)
    else:
        return None
    if not isinstance(table, dict):
        raise InputError(f"{path}: labels must map ids to names; correct it")
    return names_by_id(path, table.items())


def _points(model: Model, names: list[str], notes: list[str]) -> dict[str, Any]:
    """points, point_colors and tracks (point, view) of a capture with views of these names; nothing of few points."""
    cloud = model.cloud
    good = np.abs(cloud.means).max(1, initial=0) < cameras.FARTHEST
    if len(cloud.tracks):
        length = np.bincount(cloud.tracks[:, 0], minlength=len(good))
        good &= (length >= MIN_TRACK) & (cloud.errors <= MAX_ERROR)
    if good.sum() < LEAST:
        return {}
    if not good.all():
        notes.append(
            f"{len(good) - good.sum()} of the model's {len(good)} points are left out: fewer than {MIN_TRACK} images "
            f"see them, or they lie more than {MAX_ERROR:g} pixels off."
        )
    view = {name: row for row, name in enumerate(names)}
    of_image = np.array([view.get(common.stem(image.name), -1) for image in model.images])
    of_point = np.where(good, np.cumsum(good) - 1, -1)
    tracks = np.stack([of_point[cloud.tracks[:, 0]], of_image[cloud.tracks[:, 1]]], 1)
    return {
        "points": cloud.means[good].astype(np.float32),
        "point_colors": cloud.colors[good],
        "tracks": tracks[(tracks >= 0).all(1)].astype(np.int32),
    }


def _listing(folder: Path) -> tuple[Listing, Model]:
    place, images = _model_folder(folder), folder / "images"
    if not images.is_dir() and (undistorted := sorted(path.parent for path in folder.glob("dense/**/images"))):
        raise InputError(f"{images} is missing; {undistorted[0]} holds undistorted images and their model: name that")
    model = read_model(place)
    found = set(common.images_in(images))
    on_disk, has = len(found), probe(folder)
    masks = _pngs(folder / "masks")
    frames, absent, unmasked = [], 0, 0
    for image in model.images:
        name = common.stem(image.name)
        if image.name not in found:
            absent += 1
        else:
            mask = next((stem for stem in (image.name, name) if stem in masks), None)
            unmasked += mask is None
            frames.append(
                Frame(
                    name,
                    images / image.name,
                    cameras.camera_of(model.origin, *model.cameras[image.camera]),
                    image.pose,
                    folder / f"depth/{name}.png" if has["depth"] else None,
                    folder / f"semantic/{name}.png" if has["labels"] else None,
                    folder / f"masks/{mask}.png" if mask else None,
                )
            )
        found.discard(image.name)
    notes = [f"{absent} of {len(model.images)} images of the model are absent on disk."] if absent else []
    if found:
        notes.append(f"{len(found)} of {on_disk} images on disk are not in the model and are left out.")
    if masks and unmasked:
        notes.append(f"{unmasked} of {len(frames)} views have no mask; all their pixels count.")
    others = sum(path.is_dir() for path in (folder / "sparse").iterdir()) - 1
    if place.name == "0" and others > 0:
        notes.append(f"{others} further models beside sparse/0 are left out.")
    return Listing("colmap", frames, _label_names(folder), notes=notes), model
