"""Label maps of a source: their files, their kind, and the class of each pixel.

A view's map is a PNG of ids (grey, or a palette's), a PNG of colours, an .npy of ids [h, w] or of
scores by class ([C, h, w] or [h, w, C]), or a folder with one mask a class. All maps of a source
are of one kind, which is logged.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.images import opened
from chebsplat.formats.names import few
from chebsplat.formats.tensors import read_npy
from chebsplat.labels.names import joined, rows_of
from chebsplat.stages.sources import common, texts
from chebsplat.stages.sources.common import LABELS, Frame, LabelFile, Listing
from chebsplat.stages.sources.pictures import DEEP, GREY, companion, fits, nearest, same_shape
from chebsplat.stages.sources.texts import LONGEST, shortened, whole

IDS, COLORS, SCORES, MASKS = "ids", "colours", "scores by class", "one mask a class"
# names, `joined`, of unlabelled pixels in data sets; "other" and the like are classes
VOID = {
    "void", "ignore", "ignored", "ignoreregion", "unlabeled", "unlabelled", "notlabeled",
    "notlabelled", "nolabel", "unannotated", "notannotated", "unassigned", "unclassified",
    "undefined", "unknown", "invalid", "none", "null", "nan", "n/a", "noclass", "dontcare",
    "outlier",
}  # fmt: skip
BACKGROUND = "background"  # void where it is 0 or one of CODES, otherwise a class
CODES = (255, 65_535)  # the highest of 8 and 16 bits, which stand for void
MAX_ID = 65_535  # of 16 bits
DOCUMENTS = ("scene.json", "labels.json")  # that may name ids
MAX_COLORS = 1024  # a picture with more is no map of labels
REMEDY = "add it, or take its folder away to do without"


def place_in(folder: Path, places: Sequence[str] = LABELS) -> str | None:
    """The first of these subfolders that holds maps; None where there are none."""
    return next((place for place in places if any(files_below(folder / place))), None)


def files_below(folder: Path) -> list[str]:
    """Images and .npy files below a folder, as relative POSIX paths."""
    arrays = (
        path.relative_to(folder).as_posix() for path in folder.rglob("*.npy") if path.name[0] != "."
    )
    return sorted([*common.names_below(folder), *common.printable(folder, arrays)])


def of_views(place: Path, names: Sequence[str]) -> dict[str, LabelFile]:
    """Maps by view: a file of its name; or a mask a class, as VIEW/CLASS.png or CLASS/VIEW.png.

    Choices: a file lies in the folders of its view, or in fewer; in any other folder it is a mask.
    Raises:  InputError where one view has two, or no file has the name of a view.
    """
    files = files_below(place)
    common.distinct(sorted((os.path.splitext(name)[0], place / name) for name in files))
    matches = common.matched(names, files)
    maps: dict[str, LabelFile] = {
        name: place / file for name, file in matches.items() if _in_folders_of(name, file)
    }
    if maps:
        return maps
    by_folder: dict[str, dict[str, Path]] = {}
    for file in files:
        folder, name = os.path.split(os.path.splitext(file)[0])
        by_folder.setdefault(folder, {})[name] = place / file
    folders = common.matched(names, by_folder.keys() - {""})
    masks = {name: by_folder[folder] for name, folder in folders.items()}
    for label in () if masks else {file.partition("/")[0] for file in files if "/" in file}:
        own = [file.removeprefix(f"{label}/") for file in files if file.startswith(f"{label}/")]
        for name, file in common.matched(names, own).items():
            masks.setdefault(name, {})[label] = place / label / file
    if not masks:
        raise InputError(
            f"{place}/ holds {few(files)}, of which none is called like a photo ({few(names)}); "
            "rename the label maps"
        )
    return dict(masks)


def _in_folders_of(name: str, file: str) -> bool:
    """True where a file lies in the folders of its view, or in the innermost of them."""
    view, folders = (path.casefold().split("/")[:-1] for path in (name, file))
    return folders == view[len(view) - len(folders) :]


def files(folder: Path, places: Sequence[str] = LABELS) -> list[Path]:
    """The maps of a source's folder, in the first of `places` that holds any."""
    place = place_in(folder, places)
    return [] if place is None else [folder / place / name for name in files_below(folder / place)]


def give(listing: Listing, folder: Path, places: Sequence[str] = LABELS) -> None:
    """Give the frames of a listing their maps in the first of a folder's `places` that holds any,
    and the listing the names of the ids.
    """
    full = [place for place in places if any(files_below(folder / place))]
    for place in places if not full else ():
        if (folder / place).is_dir() and (entries := os.listdir(folder / place)):
            listing.notes.append(f"{place}/ holds no PNG or .npy: not read ({few(entries)}).")
    if not full or not listing.frames:
        return
    listing.label_place = full[0]
    listing.label_names = names_in(folder)
    maps = of_views(folder / full[0], [frame.name for frame in listing.frames])
    for frame in listing.frames:
        frame.labels = maps.get(frame.name)
    if masks := [file for file in maps.values() if isinstance(file, dict)]:
        listing.label_names = dict(enumerate(sorted(set().union(*masks)), 1))
    if full[1:]:
        listing.notes.append(f"Labels are those of {full[0]}/; not read: {', '.join(full[1:])}.")


def bits_of_ids(path: Path) -> int | None:
    """Bits of a map of ids in one channel, 8 or 16; None of any other map."""
    if path.suffix == ".npy":
        return None
    with opened(path, REMEDY) as image:
        return None if image.mode not in GREY else 16 if image.mode in DEEP else 8


def names_in(folder: Path) -> dict[int, str] | None:
    """Class names by id, of scene.json's "labels" or of labels.json: {"id" or "#rrggbb": name}."""
    scene, plain = DOCUMENTS
    path = folder / scene
    table = texts.read_json(path).get("labels") if common.present(path) else None
    if table is None and common.present(path := folder / plain):
        table = texts.read_json(path)
    if table is None:
        return None
    if not isinstance(table, dict):
        raise InputError(f"{path}: labels must map ids to names; correct it")
    return names_by_id(path, table.items())


def names_by_id(path: Path, entries: Iterable[tuple[Any, Any]]) -> dict[int, str]:
    """Class names by id, from pairs (id as number or text, or #rrggbb; name). Raises InputError."""
    names: dict[int, str] = {}
    for key, name in entries:
        try:
            if isinstance(key, str) and len(key) == 7 and key[0] == "#":
                which = int(key[1:], 16)
            else:
                which = whole(int(key) if isinstance(key, str) else key, 0, MAX_ID)
        except ValueError as error:
            raise InputError(
                f"{path}: a label's id is not usable ({str(error)[:LONGEST]}); correct it"
            ) from None
        if not isinstance(name, str) or not name.strip():
            raise InputError(
                f"{path}: label {which} has {shortened(name)} for a name; give a "
                "text that is not empty"
            )
        names[which] = name.strip()
    return names


def read(frame: Frame, listing: Listing, size: tuple[int, int], at: np.ndarray) -> np.ndarray:
    """Raw ids i32 [H, W], -1 none, at positions `at` [2, H, W] of a frame's map, with corrected
    objects; records the map's kind in the listing.
    """
    assert frame.labels is not None
    if isinstance(frame.labels, dict):
        kind, ids = MASKS, _of_masks(frame.labels, listing.label_names or {}, size, at)
    elif frame.labels.suffix == ".npy":
        kind, values = _of_array(frame.labels, size)
        ids = nearest(values, at, size)
    else:
        kind, ids = _of_image(frame.labels, size, at)
    listing.label_kinds[frame.name] = kind
    if frame.objects is not None and listing.corrections:
        objects = companion(frame.objects, size, at, GREY, "8- or 16-bit ids")
        for which, value in listing.corrections.items():
            ids[objects == which] = value
    return ids


def _of_image(path: Path, size: tuple[int, int], at: np.ndarray) -> tuple[str, np.ndarray]:
    """Kind and raw ids of a PNG; transparent pixels have none."""

    def check(image: Any) -> None:
        if image.format != "PNG":
            raise InputError(
                f"{path} is a {image.format} picture, in which ids and colours are no longer "
                "exact; write label maps as PNG or .npy"
            )
        if image.mode not in (*GREY, "1", "LA", "RGB", "RGBA"):
            raise InputError(
                f"{path} has mode {image.mode}, which is neither ids nor colours; convert it"
            )
        same_shape(path, image.size, size)

    with opened(path, REMEDY, check) as image:
        mode, values = image.mode, nearest(np.asarray(image), at, size).astype(np.int32)
    if mode in ("LA", "RGBA"):
        clear, values = values[..., -1] < 128, values[..., :-1]
    else:
        clear = np.zeros(values.shape[:2], bool)
    if values.ndim == 2 or values.shape[-1] == 1:
        kind, ids = IDS, values.reshape(clear.shape)
    else:
        kind, ids = COLORS, packed(values)
    return kind, np.where(clear, -1, ids)


def packed(colors: np.ndarray) -> np.ndarray:
    """Colours [..., 3] of 8 bits as one number each, red first."""
    return np.asarray(colors.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32))


def _of_array(path: Path, size: tuple[int, int]) -> tuple[str, np.ndarray]:
    """Kind and raw ids i32 [h, w] of an .npy, in its own resolution.

    Choices: the axis of classes is the one without which the array has the photo's shape; the
      highest score wins; equal scores, and negative ids, mean no label.
    """
    values = read_npy(path, REMEDY)
    if values.ndim == 3:
        values = (
            values[..., 0]
            if values.shape[2] == 1
            else values[0]
            if values.shape[0] == 1
            else values
        )
    if values.dtype.kind not in "biuf" or values.ndim not in (2, 3) or not values.size:
        raise InputError(
            f"{path} is {values.dtype} {values.shape}, neither ids nor scores; write it again"
        )
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{path} holds values that are not finite; write it again")
    if values.ndim == 2:
        same_shape(path, values.shape[::-1], size)
        if (values != np.floor(values)).any() or values.max() > MAX_ID:
            raise InputError(
                f"{path} holds numbers that are no ids of 0...{MAX_ID}; write ids, "
                "or scores by class"
            )
        return IDS, np.maximum(values.astype(np.int64), -1).astype(np.int32)
    sides = {0: values.shape[1:], 2: values.shape[:2]}  # by the axis that is of classes
    axis = next((k for k, (height, width) in sides.items() if fits((width, height), size)), None)
    if axis is None:
        raise InputError(
            f"{path} is {values.shape}, which has not the shape of its photo "
            f"{size[::-1]}; write it again"
        )
    if axis == 2 and values.shape[2] == 3 and values.dtype == np.uint8 and values.max() > 1:
        return COLORS, packed(values)
    best: np.ndarray = values.argmax(axis)
    return SCORES, np.where(values.max(axis) > values.min(axis), best, -1).astype(np.int32)


def _of_masks(
    masks: dict[str, Path], names: dict[int, str], size: tuple[int, int], at: np.ndarray
) -> np.ndarray:
    """Raw ids of masks by class, -1 in none of them.

    Choices: a mask is true above half of its brightest value; of two that overlap the smaller wins.
    """
    number = {name: which for which, name in names.items()}
    greys = {name: companion(path, size, at) for name, path in masks.items()}
    inside = {name: 2 * grey.astype(int) > max(int(grey.max()), 1) for name, grey in greys.items()}
    ids = np.full(at.shape[1:], -1, np.int32)
    for name in sorted(inside, key=lambda name: (-int(inside[name].sum()), name)):
        ids[inside[name]] = number[name]
    return ids


def resolved(listing: Listing, raw: np.ndarray) -> tuple[str, np.ndarray]:
    """Kind of all maps of a listing, and their raw ids [V, H, W]; colours all grey are ids.

    Raises: InputError where they are of two kinds, or of more colours than labels have.
    """
    kinds = set(listing.label_kinds.values())
    if len(kinds) > 1:
        views = {
            kind: [view for view, of in listing.label_kinds.items() if of == kind]
            for kind in sorted(kinds)
        }
        listed = ", ".join(f"{kind} ({few(some)})" for kind, some in views.items())
        raise InputError(
            f"{listing.label_place}/ holds label maps of several kinds: {listed}; write them alike"
        )
    (kind,) = kinds
    if kind == COLORS and all(
        (view[view >= 0] % packed(np.ones(3, int)) == 0).all() for view in raw
    ):
        return IDS, np.where(raw < 0, -1, raw & 255)
    if kind == COLORS and (n := len(_shares(raw))) > MAX_COLORS:
        raise InputError(
            f"{listing.label_place}/ holds {n} colours, more than labels have; write "
            "ids, unsmoothed"
        )
    return kind, raw


def line(listing: Listing, kind: str, labels: np.ndarray) -> str:
    """Kind and coverage of the maps in words. labels: i16 [V, H, W], class indices, -1 none."""
    named = (
        ""
        if kind == MASKS
        else " with names"
        if listing.label_names is not None
        else (" without names")
    )
    has_label = labels >= 0
    return (
        f"Labels of {listing.label_place}/ are taken for {kind}{named}: "
        f"{len(np.unique(labels[has_label]))} classes, {has_label.mean():.1%} of the pixels, in "
        f"{has_label.any((1, 2)).sum()} of {len(labels)} views."
    )


def indexed(
    raw: np.ndarray,
    names: dict[int, str] | None,
    class_names: tuple[str, ...] | None,
    kind: str = IDS,
    what: str = "Label",
) -> tuple[np.ndarray, list[str], list[str]]:
    """Raw ids [V, H, W] (-1: none) as indices i16 into class names; the names; notes.

    Choices: the classes are `class_names`, or else those that occur, in the order of their ids;
      spellings of one name are one class. Ids are named by `names`, else by their place in
      `class_names`, else as `unnamed` does. Void names (`is_void`) are ignored.
    Raises:  DataFailure if nothing is left.
    """
    shares = _shares(raw)
    present = [value for value in sorted(shares) if value >= 0]
    notes: list[str] = []
    if names is None and class_names is None:
        name_of, notes = unnamed(present, shares, kind, what)
    else:
        name_of = names if names is not None else dict(enumerate(class_names or ()))
        if nameless := [v for v in present if v not in name_of]:
            notes.append(
                f"{what} ids without a name are ignored: {_format_ids(nameless, shares, kind)}."
            )
    codes = (0, *CODES) if kind == IDS else (0,)
    if void := [v for v in present if v in name_of and is_void(name_of[v], v in codes)]:
        of = ", ".join(dict.fromkeys(name_of[v] for v in void))
        notes.append(
            f"{what}s called {of} are void and ignored: {_format_ids(void, shares, kind)}."
        )
    named = {v: name_of[v] for v in present if v in name_of and v not in void}
    result = list(class_names or {joined(name): name for name in named.values()}.values())
    rows = dict(zip(named, rows_of(named.values(), result), strict=True))
    if foreign := sorted({named[v] for v, row in rows.items() if row < 0}):
        notes.append(
            f"{what}s that are not among the class names are ignored: {', '.join(foreign)}."
        )
    if max(rows.values(), default=-1) < 0:
        examples = ", ".join(_format_id(v, kind) for v in present[:8])
        raise DataFailure(
            f"no label has a name ({kind} [{examples}]); give names (labels.json), or "
            "take the labels away"
        )
    every = np.array(sorted(shares))
    table = np.array([rows.get(value, -1) for value in every.tolist()], np.int16)
    labels = np.empty(raw.shape, np.int16)
    for k, view in enumerate(raw):  # one by one: a copy of all would be the largest thing in memory
        labels[k] = table[np.searchsorted(every, view)]
    return labels, result, notes


def unnamed(
    present: Sequence[int], shares: Counter[int], kind: str, what: str
) -> tuple[dict[int, str], list[str]]:
    """Names of ids that a source does not name, and a note on the one that stands for void.

    Choices: ids are class_<id>, but for 0, or for `void_code`, 0 being a class then; colours are
      themselves, but for black; of scores each is a class.
    """
    code = void_code(present) if kind == IDS else None
    void = [v for v in present if v == (0 if code is None else code)] if kind != SCORES else []
    name_of = {
        v: _format_id(v, kind) if kind == COLORS else f"class_{v}" for v in present if v not in void
    }
    meaning = (
        "is taken for none of the classes"
        if code is None
        else ("is taken for void, and 0 for a class")
    )
    lost = f"; {_format_ids(void, shares, kind)} {meaning}" if void else ""
    return name_of, [f"{what}s have no names (labels.json){lost}."]


def void_code(present: Sequence[int]) -> int | None:
    """The one of CODES that means void among ids without names, 0 being a class then; None if none.

    Choices: it is the highest id, far above the others, which are at least two and make up half of
      the numbers to the highest of them, as ids of a data set do. 0 and 255 alone are a mask.
    """
    *others, code = present or [0]
    dense = len(others) > 1 and 2 * len(others) > max(others)
    return code if code in CODES and dense and max(others) < code - 1 else None


def is_void(name: str, coded: bool) -> bool:
    """True where a name means unlabelled pixels; coded: of an id that usually does."""
    return joined(name) in VOID or (coded and joined(name) == BACKGROUND)


def _shares(raw: np.ndarray) -> Counter[int]:
    """Share of the pixels of each raw id."""
    shares: Counter[int] = Counter()
    for view in raw:
        values, counts = np.unique(view, return_counts=True)
        shares.update(dict(zip(values.tolist(), (counts / raw.size).tolist(), strict=True)))
    return shares


def _format_id(value: int, kind: str) -> str:
    return f"#{value:06x}" if kind == COLORS else str(value)


def _format_ids(values: Sequence[int], shares: Counter[int], kind: str) -> str:
    """Ids with their shares of the pixels."""
    return ", ".join(f"{_format_id(v, kind)} ({shares[v]:.1%} of the pixels)" for v in values)
