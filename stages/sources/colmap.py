"""The COLMAP source: images/ and a model in sparse/0, with depth/, semantic/ and masks/ where they are given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import common
from chebsplat.stages.sources.common import Camera, Frame, Listing

HELP = "correct source.path; a COLMAP source holds images/ and sparse/0/{cameras,images,points3D}.bin or .txt"


def read(folder: Path, settings: Any) -> dict[str, Any]:
    """The fields of a capture; `is_test` too, if scene.json says which views are."""
    listing = _listing(folder)
    fields = common.assemble(listing, settings)
    document = _document(folder)
    if "test_every" in document:
        every = int(document["test_every"])
        fields["is_test"] = np.arange(len(fields["names"])) % every == settings.test_offset % every
        fields["source"]["notes"].append(f"Every {every}th view is test (scene.json).")
    return fields


def probe(folder: Path) -> dict[str, bool]:
    """Light: looks at folders, reads no model and no pixel."""
    return {
        "poses": True,
        "depth": _complete(folder, "depth"),
        "labels": _complete(folder, "semantic"),
    }


def files(folder: Path) -> list[Path]:
    """Every file that `read` depends on."""
    model = _model_folder(folder)
    documents = [folder / name for name in ("scene.json", "labels.json") if (folder / name).is_file()]
    data = [p for name in ("images", "depth", "semantic", "masks") if (folder / name).is_dir()
            for p in (folder / name).rglob("*") if p.suffix.lower() in common.IMAGE_TYPES]  # fmt: skip
    return sorted([*(p for p in model.iterdir() if p.suffix in (".bin", ".txt")), *documents, *data])


def _complete(folder: Path, what: str) -> bool:
    """As many files as images: a cheap stand-in for the check by name that `read` makes."""
    if not (folder / what).is_dir() or not (folder / "images").is_dir():
        return False
    counts = [
        sum(1 for p in (folder / n).rglob("*") if p.suffix.lower() in common.IMAGE_TYPES) for n in (what, "images")
    ]
    return counts[0] >= counts[1] > 0


def _model_folder(folder: Path) -> Path:
    for place in ("sparse/0", "sparse"):
        if any((folder / place / f"cameras.{end}").is_file() for end in ("bin", "txt")):
            return folder / place
    raise InputError(f"{folder / 'sparse/0'} holds no COLMAP model (cameras.bin or cameras.txt); {HELP}")


def _document(folder: Path) -> dict[str, Any]:
    return common.read_json(folder / "scene.json") if (folder / "scene.json").is_file() else {}


def _label_names(folder: Path) -> dict[int, str] | None:
    table = _document(folder).get("labels")
    if table is None and (folder / "labels.json").is_file():
        table = common.read_json(folder / "labels.json")
    if table is None:
        return None
    try:
        return {int(key): str(value) for key, value in table.items()}
    except (AttributeError, ValueError):
        raise InputError(f"{folder}: labels in scene.json or labels.json must map ids to names") from None


def _listing(folder: Path) -> Listing:
    import pycolmap

    place, images = _model_folder(folder), folder / "images"
    try:
        model = pycolmap.Reconstruction(place)
    except Exception as error:  # pycolmap raises several types, RuntimeError among them
        raise InputError(f"{place} is not a readable COLMAP model ({error}); {HELP}") from None
    found = {path.relative_to(images).as_posix(): path for path in common.images_in(images)}
    frames, absent = [], 0
    for image in model.images.values():
        path = found.pop(image.name, None)
        if path is None:
            absent += 1
            continue
        if not image.has_pose:
            continue
        camera = model.cameras[image.camera_id]
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        stem = str(Path(image.name).with_suffix(""))
        mask = common.beside(folder / "masks", image.name) or common.beside(folder / "masks", stem)
        frames.append(
            Frame(
                stem,
                path,
                Camera(camera.model.name, list(camera.params), camera.width, camera.height),
                pose,
                common.beside(folder / "depth", stem),
                common.beside(folder / "semantic", stem),
                mask,
            )
        )
    notes = []
    if absent:
        notes.append(f"{absent} images of the model are absent on disk.")
    if found:
        notes.append(f"{len(found)} images on disk are not in the model and are left out.")
    return Listing("colmap", frames, _label_names(folder), notes=notes)
