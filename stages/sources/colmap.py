"""The COLMAP source: images/ and a model in sparse/0, with depth/, semantic/ and masks/ where they are given."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import assembly, common
from chebsplat.stages.sources.common import Frame, Listing

HELP = "correct source.path; a COLMAP source holds images/ and sparse/0/{cameras,images,points3D}.bin or .txt"
COMPANIONS = {"depth": "depth", "semantic": "labels"}  # folder: what its PNGs are
LEAST = {"cameras.bin": 48, "images.bin": 73, "points3D.bin": 51}  # bytes of the shortest record


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture; `is_test` too, if scene.json says which views are.

    Choices: scene.json's split counts all of its frames, so `max_views` never moves a view from one side to the
      other; if it leaves one side empty, the split is not given and a note says so.
    """
    listing = _listing(folder)
    fields = assembly.assemble(listing, settings, class_names)
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
    documents = [folder / name for name in ("scene.json", "labels.json") if (folder / name).is_file()]
    data = [folder / place / name for place in ("images", *COMPANIONS, "masks")
            for name in common.names_below(folder / place)]  # fmt: skip
    return sorted([*model, *documents, *data])


def _pngs(folder: Path) -> set[str]:
    return {name[:-4] for name in common.names_below(folder) if name.endswith(".png")}


def _model_folder(folder: Path) -> Path:
    for place in ("sparse/0", "sparse"):
        if any((folder / place / f"cameras.{end}").is_file() for end in ("bin", "txt")):
            return folder / place
    raise InputError(f"{folder / 'sparse/0'} holds no COLMAP model (cameras.bin or cameras.txt); {HELP}")


def _document(folder: Path) -> dict[str, Any]:
    return common.read_json(folder / "scene.json") if (folder / "scene.json").is_file() else {}


def _split(folder: Path, names: list[str]) -> set[str] | None:
    """Names of the test views: every `test_every`-th frame of scene.json, from its first on; None if it has no say."""
    document = _document(folder)
    if "test_every" not in document:
        return None
    try:
        every = int(document["test_every"])
        listed = [common.stem(str(frame["file"])) for frame in document.get("frames", [])]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / 'scene.json'}: test_every or frames are not usable ({error}); restore it"
        ) from None
    if every < 2:
        raise InputError(f"{folder / 'scene.json'}: test_every is {every}; it must be 2 or more")
    return set((listed or sorted(names, key=common.natural))[::every])


def _label_names(folder: Path) -> dict[int, str] | None:
    """Class names by id, of scene.json's "labels" or of labels.json: {"id": name}."""
    table = _document(folder).get("labels")
    if table is None and (folder / "labels.json").is_file():
        table = common.read_json(folder / "labels.json")
    if table is None:
        return None
    try:
        return {int(key): str(value) for key, value in table.items()}
    except (AttributeError, ValueError):
        raise InputError(f"{folder}: labels in scene.json or labels.json must map ids to names; correct it") from None


def _listing(folder: Path) -> Listing:
    place, images = _model_folder(folder), folder / "images"
    if not images.is_dir() and (undistorted := sorted(path.parent for path in folder.glob("dense/**/images"))):
        raise InputError(f"{images} is missing; {undistorted[0]} holds undistorted images and their model: name that")
    model = _model(place)
    found = set(common.images_in(images))
    on_disk, has = len(found), probe(folder)
    masks = _pngs(folder / "masks")
    frames, absent, unposed, unmasked = [], 0, 0, 0
    for image in model.images.values():
        name = common.stem(image.name)
        if image.name not in found:
            absent += 1
        elif not image.has_pose:
            unposed += 1
        else:
            camera = model.cameras[image.camera_id]
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().matrix()
            mask = next((stem for stem in (image.name, name) if stem in masks), None)
            unmasked += mask is None
            frames.append(
                Frame(
                    name,
                    images / image.name,
                    common.camera_of(place, camera.model.name, camera.params, camera.width, camera.height),
                    pose,
                    folder / f"depth/{name}.png" if has["depth"] else None,
                    folder / f"semantic/{name}.png" if has["labels"] else None,
                    folder / f"masks/{mask}.png" if mask else None,
                )
            )
        found.discard(image.name)
    notes = [f"{absent} of {len(model.images)} images of the model are absent on disk."] if absent else []
    if unposed:
        notes.append(f"{unposed} images of the model have no pose and are left out.")
    if found:
        notes.append(f"{len(found)} of {on_disk} images on disk are not in the model and are left out.")
    if masks and unmasked:
        notes.append(f"{unmasked} of {len(frames)} views have no mask; all their pixels count.")
    others = sum(path.is_dir() for path in (folder / "sparse").iterdir()) - 1
    if place.name == "0" and others > 0:
        notes.append(f"{others} further models beside sparse/0 are left out.")
    return Listing("colmap", frames, _label_names(folder), notes=notes)


def _model(place: Path) -> Any:
    """The reconstruction. Raises InputError; a binary file that cannot hold what it counts is never parsed."""
    for name, least in LEAST.items():
        path = place / name
        if path.is_file():
            with path.open("rb") as handle:
                start = handle.read(8)
            if len(start) < 8 or 8 + struct.unpack("<Q", start)[0] * least > path.stat().st_size:
                raise InputError(f"{path} is cut off; copy it again")
    import pycolmap

    try:
        return pycolmap.Reconstruction(place)
    except Exception as error:  # pycolmap raises ValueError, IndexError and RuntimeError
        raise InputError(f"{place} is not a readable COLMAP model ({error}); {HELP}") from None
