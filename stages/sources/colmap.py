"""The COLMAP source: images/ and models in sparse/; optional depth/, label maps and masks/."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.cameras import centers
from chebsplat.errors import InputError
from chebsplat.formats.names import few
from chebsplat.formats.world import World
from chebsplat.stages.sources import assembly, cameras, common, labels, texts
from chebsplat.stages.sources.colmap_model import Cloud, Model, read_model, size_of
from chebsplat.stages.sources.common import Frame, Listing

HELP = (
    "correct source.path; a COLMAP source holds images/ and "
    "sparse/0/{cameras,images,points3D}.bin or .txt"
)
FEW = 10**6  # more than any test_every
MIN_TRACK = 3  # images that see a point: two can match by chance
MAX_ERROR = 4.0  # pixels, of a point's mean reprojection error
LEAST = 100  # good points; from a model with fewer somebody has removed the points


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture; `is_test` too, if scene.json names test views.

    Choices: scene.json's split counts all of its frames, so `max_views` never moves a view from one
      side to the other; if it leaves one side empty, the split is not used, and a note says so. The
      model's points are used unless there is depth, which gives more and is checked against them
      (`landmarks`); points with tracks of fewer than MIN_TRACK images, or with a mean error above
      MAX_ERROR pixels, are left out.
    """
    listing, model = _listing(folder)
    fields = assembly.assemble(listing, settings, class_names)
    lost = assembly.in_empty_space(model.cloud.means, fields, listing)
    points = points_of(
        model.cloud, [common.stem(image.name) for image in model.images], fields, lost
    )
    if "depth" in fields and settings.depth == "auto":
        fields["landmarks"] = points
    else:
        fields |= points
    split = _split(folder, [frame.name for frame in listing.frames])
    if split is not None:
        assembly.give_split(fields, split, "scene.json")
    return fields


def probe(folder: Path) -> dict[str, bool]:
    """Reads names only. Where one view has depth, all must: `read` fails otherwise."""
    return {
        "poses": True,
        "depth": any(_pngs(folder / "depth")),
        "labels": labels.place_in(folder) is not None,
    }


def files(folder: Path) -> list[Path]:
    """The model, scene.json, labels.json, and every image, depth, label map and mask."""
    model = [
        path
        for place in _models(folder)
        for path in place.iterdir()
        if path.suffix in (".bin", ".txt")
    ]
    documents = [folder / name for name in labels.DOCUMENTS if common.present(folder / name)]
    places = [
        common.photo_folder(folder),
        *(folder / name for name in ("depth", "masks", "confidence")),
    ]
    data = [place / name for place in places for name in common.names_below(place)]
    return sorted([*model, *documents, *data, *labels.files(folder)])


def _pngs(folder: Path) -> Iterator[tuple[str, Path]]:
    """PNGs below a folder, by the name of their view."""
    return (
        (name[:-4], folder / name)
        for name in common.names_below(folder)
        if name.lower().endswith(".png")
    )


def _models(folder: Path) -> list[Path]:
    """The folders of all models: in sparse/, sparse/ itself, and nerfstudio's colmap/sparse/."""
    roots = [root for root in (folder / "sparse", folder / "colmap/sparse") if root.is_dir()]
    places = [place for root in roots for place in (*sorted(root.iterdir(), key=_natural), root)]
    models = [
        p for p in places if any(common.present(p / f"cameras.{end}") for end in ("bin", "txt"))
    ]
    if not models:
        raise InputError(
            f"{folder / 'sparse/0'} holds no COLMAP model (cameras.bin or cameras.txt); {HELP}"
        )
    return models


def _natural(path: Path) -> Any:
    return common.natural(path.name)


def _model_folder(folder: Path) -> tuple[Path, list[str]]:
    """The model with the most images, the first of equals; a note that names any others."""
    places = _models(folder)
    if len(places) == 1:
        return places[0], []
    sizes = [size_of(place) for place in places]
    best = sizes.index(max(sizes))
    entries = [
        f"{place.relative_to(folder)} ({size} images)"
        for place, size in zip(places, sizes, strict=True)
    ]
    others = ", ".join(entries[:best] + entries[best + 1 :])
    return places[best], [f"The largest model is taken, {entries[best]}; left out: {others}."]


def _document(folder: Path) -> dict[str, Any]:
    path = folder / "scene.json"
    return texts.read_json(path) if common.present(path) else {}


def _split(folder: Path, names: list[str]) -> set[str] | None:
    """Names of the test views: every `test_every`-th frame of scene.json, if it has that key."""
    document = _document(folder)
    if "test_every" not in document:
        return None
    try:
        every = texts.whole(document["test_every"], 2, FEW)
        listed = [common.stem(frame["file"]) for frame in document.get("frames", [])]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / 'scene.json'}: test_every or the frames' files are not usable ({error}); "
            "restore it"
        ) from None
    return set((listed or sorted(names, key=common.natural))[::every])


def points_of(
    cloud: Cloud, images: list[str], fields: dict[str, Any], lost: np.ndarray | None = None
) -> dict[str, Any]:
    """points, point_colors and tracks (point, view) of a capture of these fields, unless too few.

    Args:    images: names of the views that the cloud's tracks count; lost: mask of points to drop.
    Choices: a point without an error is used.
    """
    names, notes = fields["names"], fields["source"]["notes"]
    within = World.of(centers(fields["cam_from_world"])).inward(cloud.means)
    good = np.abs(within).max(1, initial=0) < cameras.WIDEST
    if len(cloud.tracks):
        length = np.bincount(cloud.tracks[:, 0], minlength=len(good))
        good &= (length >= MIN_TRACK) & ~(cloud.errors > MAX_ERROR)
    if not good.all():
        notes.append(
            f"{len(good) - good.sum()} of the model's {len(good)} points are left out: fewer than "
            f"{MIN_TRACK} images see them, or they lie more than {MAX_ERROR:g} pixels off."
        )
    good &= True if lost is None else ~lost
    if good.sum() < LEAST:
        if len(good):
            notes.append(
                f"{good.sum()} points are left, fewer than {LEAST}: none is used, and "
                "photos are matched."
            )
        return {}
    view = {name: row for row, name in enumerate(names)}
    of_image = np.array(
        [[view.get(each, -1) for each in (name, *assembly.face_names(name))] for name in images]
    )
    of_point = np.where(good, np.cumsum(good) - 1, -1)
    # of each track's photo: the rows of its faces, of which the one with the point ahead counts
    rows = of_image.reshape(len(images), -1)[cloud.tracks[:, 1]]
    ahead = np.concatenate([fields["cam_from_world"][:, 2], np.zeros((1, 4))])[rows]
    depth = np.einsum("trk,tk->tr", ahead[..., :3], cloud.means[cloud.tracks[:, 0]]) + ahead[..., 3]
    views = np.take_along_axis(rows, np.where(rows < 0, -np.inf, depth).argmax(1)[:, None], 1)[:, 0]
    tracks = np.stack([of_point[cloud.tracks[:, 0]], views], 1)
    return {
        "points": cloud.means[good],
        "point_colors": cloud.colors[good],
        "tracks": tracks[(tracks >= 0).all(1)].astype(np.int32),
    }


def _listing(folder: Path) -> tuple[Listing, Model]:
    """The frames, and the model with its images named by their files, "" where absent."""
    place, notes = _model_folder(folder)
    images = common.photo_folder(folder)
    if not images.is_dir() and (
        undistorted := sorted(path.parent for path in folder.glob("dense/**/images"))
    ):
        raise InputError(
            f"{images} is missing; {undistorted[0]} holds undistorted images and "
            "their model: name that"
        )
    model = read_model(place)
    notes += model.notes
    on_disk, listed = common.images_in(images), [image.name for image in model.images]
    files = common.matched(listed, on_disk)
    pngs = dict(_pngs(folder / "depth"))
    masks, unmasked = common.masks_in(folder, files.values())
    frames = []
    for image in model.images:
        if file := files.get(image.name):
            name = common.stem(file)
            camera = cameras.camera_of(model.origin, *model.cameras[image.camera])
            depth = pngs.get(name, folder / f"depth/{name}.png") if pngs else None
            sure = common.sureness(depth) if depth else None
            frames.append(
                Frame(
                    name,
                    images / file,
                    camera,
                    image.pose,
                    depth,
                    sureness=sure,
                    mask=masks.get(file),
                )
            )
    rest = set(on_disk) - set(files.values())
    absent = [name for name in listed if name not in files]
    if absent:
        notes.append(
            f"{len(absent)} of {len(listed)} images of the model are absent on disk "
            f"({few(absent)})."
        )
    if rest:
        notes.append(
            f"{len(rest)} of {len(on_disk)} images on disk are not in the model and are left out "
            f"({few(rest)})."
        )
    if by_stem := sum(name != file for name, file in files.items()):
        notes.append(
            f"{by_stem} of the model's images have another path on disk and are told by "
            "their names."
        )
    if images.name != "images":
        notes.append(f"Photos are those of {images.name}/.")
    model = replace(
        model, images=[replace(image, name=files.get(image.name, "")) for image in model.images]
    )
    listing = Listing("colmap", frames, notes=notes + unmasked)
    labels.give(listing, folder)
    return listing, model
