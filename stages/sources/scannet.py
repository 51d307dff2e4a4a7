"""ScanNet as exported by its own tools, and by two groups: Semantic Gaussians (SG: points3d.ply and
a table of 20 classes) and Panoptic Lifting (PL: splits.json).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.evaluation.protocols import scannet_closed, scannet_open
from chebsplat.formats.images import header
from chebsplat.formats.points import read_cloud
from chebsplat.stages.sources import assembly, cameras, common, labels, texts
from chebsplat.stages.sources.cameras import Camera
from chebsplat.stages.sources.common import Frame, Listing, present
from chebsplat.stages.sources.texts import LONGEST, read_table

SENSOR = 1296  # width of the colour sensor, which intrinsics refer to even where images are reduced
OFF_CENTRE = 0.1  # of the width, by which a principal point may lie off the middle
POINTS = "points3d.ply"
# of Mask2Former with test-time augmentation
PSEUDO, CONFIDENCE = "m2f_semantics", "m2f_probabilities"
PL_IDS = "semantics"  # PL's folder of ScanNet's own ids
# never in an SG folder
OF_PL = ("splits.json", "segmentation_data.pkl", "rs_semantics", "m2f_semantics")
MODIFIED, COMBINED = "scannetv2-labels.modified.tsv", "scannet-labels.combined.tsv"
OWN = "scannetv2-labels.combined.tsv"  # ScanNet's, of which COMBINED is PL's copy
NYU = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror",
    "floor mat", "clothes", "ceiling", "books", "refrigerator", "television", "paper", "towel",
    "shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp",
    "bathtub", "bag", "otherstructure", "otherfurniture", "otherprop",
)  # fmt: skip
OTHER = "otherprop"  # SG's id 0: ignored
CORRECTED = 60_000  # plus an NYU class: raw ids of hand-corrected objects, above all of ScanNet's
# Objects that the authors of Panoptic Lifting relabel by hand, as ScanNet has them wrong: object id
# -> NYU class.
CORRECTIONS: dict[str, dict[int, int]] = {
    "scene0050_02": {24: 37, 26: 37, 12: 6, 1: 6, 16: 9},
    "scene0144_01": {4: 3, 13: 3, 5: 3},
    "scene0221_01": {15: 7, 36: 15, 37: 1, 38: 1},
    "scene0300_01": {13: 25, 14: 25, 20: 37},
    "scene0389_00": {19: 37, 20: 3, 21: 3, 28: 37},
    "scene0423_02": {6: 7},
    "scene0616_00": {21: 1, 22: 1, 24: 1, 25: 1, 30: 1, 31: 1},
    "scene0645_02": {5: 7, 6: 3, 25: 5, 41: 5, 27: 37, 32: 37, 34: 37, 60: 0, 61: 37},
    "scene0693_00": {1: 1, 4: 1, 6: 3, 11: 8, 20: 40},
}


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture; SG's `points` and `point_colors`, PL's `is_test`."""
    listing = _listing(folder)
    reduced = _is_reduced(folder)
    split = _split(folder / "splits.json") if reduced else None
    if split is not None:
        listed = split[0] | split[1]
        outside = [frame for frame in listing.frames if frame.name not in listed]
        listing.frames = [frame for frame in listing.frames if frame.name in listed]
        if outside:
            listing.notes.append(
                f"{len(outside)} frames are in neither list of splits.json and are left out."
            )
    fields = assembly.assemble(listing, settings, class_names)
    if split is not None:
        assembly.give_split(fields, split[1], "splits.json")
    if not reduced and common.present(folder / POINTS):
        fields["points"], fields["point_colors"] = read_cloud(folder / POINTS)
    return fields


def probe(folder: Path) -> dict[str, bool]:
    """Reads names only. Where one frame has depth, all must: `read` fails otherwise."""
    return {
        "poses": True,
        "depth": any(common.names_below(folder / "depth")),
        "labels": _labels_folder(folder) is not None,
        "pseudo_labels": _has_pseudo_labels(folder),
    }


def files(folder: Path) -> list[Path]:
    """Poses, intrinsics, points, split, label table, and images, depth, label and object maps."""
    table = _table(folder)
    with_objects = _is_reduced(folder) and _labels_folder(folder) == PL_IDS
    places = ["color", "depth", *(["instance"] if with_objects else [])]
    data = [folder / of / name for of in places for name in common.names_below(folder / of)]
    data += labels.files(folder, _label_places(folder))
    texts = [path for place in ("pose", "intrinsic") for path in (folder / place).glob("*.txt")]
    if _has_pseudo_labels(folder):
        data += [folder / PSEUDO / name for name in common.names_below(folder / PSEUDO)]
        texts += list((folder / CONFIDENCE).glob("*.npz"))
    single = [
        folder / name
        for name in (POINTS, "splits.json", *labels.DOCUMENTS)
        if common.present(folder / name)
    ]
    return sorted(
        [*data, *texts, *single, *([table] if table is not None and common.present(table) else [])]
    )


def _has_pseudo_labels(folder: Path) -> bool:
    return (folder / CONFIDENCE).is_dir() and any(common.names_below(folder / PSEUDO))


def _is_reduced(folder: Path) -> bool:
    """True where the folder is PL's."""
    return any((folder / name).exists() for name in OF_PL)


def _label_places(folder: Path) -> tuple[str, ...]:
    """Folders of labels, the best first."""
    return ("rs_semantics", PL_IDS) if _is_reduced(folder) else ("label-filt", *common.LABELS)


def _labels_folder(folder: Path) -> str | None:
    return labels.place_in(folder, _label_places(folder))


def _table(folder: Path) -> Path | None:
    """The nearest table of ScanNet's ids; where there is none, the path where it should be."""
    place, reduced = _labels_folder(folder), _is_reduced(folder)
    if place in (None, "rs_semantics"):
        return None
    names = (COMBINED,) if reduced else (MODIFIED, OWN, COMBINED)
    return next(
        filter(None, (common.nearest_file(folder, name) for name in names)), folder / names[0]
    )


def _give_labels(listing: Listing, folder: Path) -> None:
    """Give the frames their label maps, and the listing the names of their ids.

    Choices: PL's have its names; otherwise labels.json goes first. In label/ and the like ids of 16
      bits are ScanNet's own, those of 8 bits NYU's 40, as in the set of 25,000 frames. Colours and
      .npy files are named by labels.json alone.
    """
    labels.give(listing, folder, _label_places(folder))
    place = listing.label_place
    if not place:
        return
    maps = [frame.labels for frame in listing.frames if isinstance(frame.labels, Path)]
    if place == "rs_semantics" and maps:
        listing.label_names = dict(enumerate(("void", *scannet_closed.CLASSES)))
    elif place == PL_IDS and maps and _is_reduced(folder):
        listing.label_names, listing.corrections = reduced_names(
            _table(folder), folder.resolve().name
        )
        for frame in listing.frames:
            frame.objects = folder / f"instance/{frame.name}.png" if frame.labels else None
        if listing.corrections:
            listing.notes.append(
                f"{len(listing.corrections)} objects take the hand-corrected labels of this scene."
            )
    elif listing.label_names is not None or (bits := labels.bits_of_ids(maps[0])) is None:
        listing.class_names = None
    elif place != "label-filt" and bits == 8:
        listing.label_names = dict(enumerate(("void", *NYU)))
        listing.class_names = None
        listing.notes.append(f"Ids of {place}/ have 8 bits and are taken for NYU's 40 classes.")
    elif (table := _table(folder)) is not None and table.name != MODIFIED:
        nyu = _column(table, OWN, "nyu40id", 41, empty=40)
        listing.label_names = {raw: ("void", *NYU)[k] for raw, k in nyu.items()} | {0: "void"}
        listing.class_names = None
        listing.notes.append(
            f"Classes are NYU's 40, of {table.name}; scannet-open has 20, of {MODIFIED}."
        )
    else:
        listing.label_names = mapped(table)


def _camera(folder: Path, kind: str, size: tuple[int, int], sensor: int) -> Camera:
    """The camera of the colour or depth images.

    Choices: intrinsics are those of the images as they are or of the whole sensor, whichever has
      its principal point nearer to the middle; they count from the centre of the first pixel, as
      depth's 319.5 of 640 shows.
    """
    path = folder / f"intrinsic/intrinsic_{kind}.txt"
    K = texts.read_matrix(path)
    whole = min((size[0], sensor), key=lambda width: abs(2 * K[0, 2] - width))
    if abs(2 * K[0, 2] - whole) > OFF_CENTRE * whole:
        raise InputError(
            f"{path}: a principal point at {K[0, 2]:g} fits no width of {size[0]}; restore the file"
        )
    factor = size[0] / whole
    params = (
        K[0, 0] * factor,
        K[1, 1] * factor,
        (K[0, 2] + 0.5) * factor,
        (K[1, 2] + 0.5) * factor,
    )
    return cameras.camera_of(path, "PINHOLE", params, *size)


def _split(path: Path) -> tuple[set[str], set[str]] | None:
    """(training, test) names of splits.json, None without one."""
    if not common.present(path):
        return None
    document = texts.read_json(path)
    lists: list[Any] = [document.get(side) for side in ("train", "test")]
    if not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists
    ):
        raise InputError(f"{path} lacks lists of train and test names; restore the file")
    sides = [set(names) for names in lists]
    if both := sides[0] & sides[1]:
        raise InputError(
            f"{path}: {min(both)} is both a training and a test view; restore the file"
        )
    return sides[0], sides[1]


def _listing(folder: Path) -> Listing:
    images = common.images_in(folder / "color")
    names = [common.stem(name) for name in images]
    matrices = np.array([texts.read_matrix(folder / f"pose/{name}.txt") for name in names])
    poses = cameras.cam_from_world(folder / "pose", matrices, names)
    size, _ = header(folder / "color" / images[0])
    camera = _camera(folder, "color", size, SENSOR)
    has = probe(folder)
    pseudo = has["pseudo_labels"]
    frames = [
        Frame(
            name,
            folder / "color" / image,
            camera,
            pose,
            folder / f"depth/{name}.png" if has["depth"] else None,
            pseudo_labels=folder / f"{PSEUDO}/{name}.png" if pseudo else None,
            confidence=folder / f"{CONFIDENCE}/{name}.npz" if pseudo else None,
        )
        for name, image, pose in zip(names, images, poses, strict=True)
    ]
    reduced = _is_reduced(folder)
    protocol = scannet_closed if reduced else scannet_open
    listing = Listing(
        "scannet", frames, class_names=protocol.CLASSES if has["labels"] or pseudo else None
    )
    listing.pseudo_names = dict(enumerate(("void", *scannet_closed.CLASSES))) if pseudo else None
    intrinsics = folder / "intrinsic/intrinsic_color.txt"
    listing.notes += texts.skew_note(intrinsics, texts.read_matrix(intrinsics))
    listing.notes.append(
        f"ScanNet as {'Panoptic Lifting' if reduced else 'Semantic Gaussians'} lays it out."
    )
    if not reduced and not common.present(folder / POINTS):
        listing.notes[-1] = (
            f"ScanNet as its own tools export it, without {POINTS}: points are of "
            "depth, or matched."
        )
    if extra := sum(path.stem not in set(names) for path in (folder / "pose").glob("*.txt")):
        listing.notes.append(f"{extra} poses have no image in color/ and are left out.")
    if has["depth"] and common.present(folder / "intrinsic/intrinsic_depth.txt"):
        depth_size, _ = header(folder / f"depth/{names[0]}.png")
        listing.depth_camera = _camera(folder, "depth", depth_size, depth_size[0])
    _give_labels(listing, folder)
    others = ("segmentation_data.pkl", "m2f_invalid", *(() if pseudo else (PSEUDO, CONFIDENCE)))
    if unused := [name for name in others if (folder / name).exists()]:
        listing.notes.append(f"Not read: {', '.join(unused)}.")
    return listing


def mapped(path: Path | None) -> dict[int, str]:
    """Class names by raw id through the table's column `cocomapid`; 0 is `otherprop`, no class."""
    names = (OTHER, *scannet_open.CLASSES)
    return {
        raw: names[value] for raw, value in _column(path, MODIFIED, "cocomapid", len(names)).items()
    }


def reduced_names(path: Path | None, scene: str) -> tuple[dict[int, str], dict[int, int]]:
    """Class names by raw id through the table's column `nyu40id`; the corrections by object id.

    Choices: an id whose `nyu40id` is empty is NYU's 40, other props; 0 is void.
    """
    nyu = _column(path, COMBINED, "nyu40id", 41, empty=40)
    names = {raw: scannet_closed.REDUCED[value] for raw, value in nyu.items()} | {0: "void"}
    fixes = CORRECTIONS.get(scene, {})
    names |= {CORRECTED + value: scannet_closed.REDUCED[value] for value in fixes.values()}
    return names, {which: CORRECTED + value for which, value in fixes.items()}


def _column(
    path: Path | None, name: str, column: str, n_values: int, empty: int | None = None
) -> dict[int, int]:
    """A column of whole numbers below `n_values`, by the column `id`; an id's last row counts."""
    if path is None or not present(path):
        raise InputError(f"{path} is missing; put {name} into the scene's folder or one above it")
    rows = read_table(path, f"take {name}")
    try:
        by_id = {
            int(row["id"]): int(row[column]) if row[column] or empty is None else empty
            for row in rows
        }
    except (KeyError, TypeError, ValueError) as error:
        reason = str(error)[:LONGEST]
        raise InputError(
            f"{path} has no usable columns id and {column} ({reason}); take {name}"
        ) from None
    if not by_id or min(by_id) < 0 or not all(0 <= value < n_values for value in by_id.values()):
        raise InputError(
            f"{path}: ids must not be negative, and values of {column} must lie in "
            f"0...{n_values - 1}; take {name}"
        )
    return by_id
