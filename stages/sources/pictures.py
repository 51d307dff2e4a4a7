"""The images of a source: photos, the one-channel images that belong to them, and what label ids mean."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.images import opened, seen_size, turned
from chebsplat.formats.tensors import finite32, read_npz
from chebsplat.stages.sources.cameras import SAME_SHAPE
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.texts import LONGEST, shortened, whole

EIGHT_BIT = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"}  # PIL's modes of photos
DEEP = {"I", "I;16", "I;16B"}  # 16-bit
GREY = DEEP | {"L", "P"}
LARGEST = 16 << 20  # bytes of a view's confidences: 4 million in single precision
IGNORED = {"void", "ignore", "ignored", "unlabeled", "unlabelled", "undefined", "unknown"}
MAX_ID = 65_535  # what 16 bits hold


@contextmanager
def open_photo(path: Path, size: tuple[int, int], upright: bool) -> Iterator[tuple[Any, np.ndarray | None]]:
    """An RGB image of (width, height) `size`, and where it is opaque (None: everywhere), as `opened` gives one.

    Choices: a model's own photos are turned by EXIF only if they fit its camera no other way, since COLMAP counts
      pixels as they are stored. What is transparent is empty: it lies before black, as what is rendered does; alpha
      under one half is transparent.
    """

    def check(image: Any) -> None:
        if image.mode not in EIGHT_BIT:
            raise InputError(f"{path} is no 8-bit photo (mode {image.mode}); convert it to 8 bits")
        found = seen_size(image) if upright or image.size != size else image.size
        if found != size:
            raise InputError(f"{path} is {_by(found)}, its camera {_by(size)}; restore the image or its camera")

    with opened(path, check=check) as image:
        if upright or image.size != size:
            image = turned(image)
        if "A" not in image.mode and "transparency" not in image.info:
            yield (image if image.mode == "RGB" else image.convert("RGB")), None
            return
        image = image if image.mode == "RGBA" else image.convert("RGBA")
        alpha = image.getchannel("A")
        black = Image.new("RGB", image.size)
        black.paste(image, mask=alpha)
        opaque = np.asarray(alpha) >= 128
        yield black, None if opaque.all() else opaque


def companion(
    path: Path,
    size: tuple[int, int],
    at: np.ndarray,
    modes: set[str] | None = None,
    wanted: str = "",
) -> np.ndarray:
    """The pixels at `at` [2, H, W] of a one-channel image that belongs to a photo of (width, height) `size`, in any
    resolution of that photo's shape.

    Args: modes: PIL's, that are taken as they are; None: all, as grey values.
    Raises: InputError naming the file.
    """

    def check(image: Any) -> None:
        if modes is not None and image.mode not in modes:
            raise InputError(f"{path} has mode {image.mode}, not {wanted} in one channel; convert it")
        alike = abs(image.width * size[1] / (image.height * size[0]) - 1) < SAME_SHAPE
        if image.size != size and not alike:
            raise InputError(f"{path} is {_by(image.size)}, its photo {_by(size)}; restore it")

    with opened(path, "add it, or take its folder away to do without", check) as image:
        grey = image if modes is not None or image.mode in DEEP else image.convert("L")
        return nearest(np.asarray(grey), at, size)


def confidences(path: Path) -> np.ndarray:
    """The array `confidence` [h, w] of an .npz file, f32 in [0, 1]; nothing in it is unpickled. Raises InputError."""
    held = read_npz(path, ["confidence"], "copy it again", LARGEST).get("confidence")
    found = None if held is None else finite32(held)
    if found is None or found.ndim != 2 or not found.size or not ((found >= 0) & (found <= 1 + 1e-4)).all():
        raise InputError(f"{path}: `confidence` must be an image of values in 0...1; copy it again")
    return found.clip(0, 1)


def nearest(values: np.ndarray, at: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The stored pixels [H, W] of `values` [h, w] that hold positions `at` [2, H, W] in a photo of (width, height)."""
    height, width = values.shape
    column = np.clip(np.floor(at[0] * (width / size[0])).astype(int), 0, width - 1)
    row = np.clip(np.floor(at[1] * (height / size[1])).astype(int), 0, height - 1)
    return values[row, column]


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def label_ids(frame: Frame, listing: Listing, size: tuple[int, int], at: np.ndarray) -> np.ndarray:
    """Raw ids i32 [H, W] at positions `at` [2, H, W] of a frame's label image, its corrected objects replaced."""
    assert frame.labels is not None
    ids = companion(frame.labels, size, at, GREY, "8- or 16-bit ids").astype(np.int32)
    if frame.objects is not None and listing.corrections:
        objects = companion(frame.objects, size, at, GREY, "8- or 16-bit ids")
        for which, value in listing.corrections.items():
            ids[objects == which] = value
    return ids


def names_by_id(path: Path, entries: Iterable[tuple[Any, Any]]) -> dict[int, str]:
    """Class names by id, from pairs in a document; ids may be written as text. Raises InputError."""
    names: dict[int, str] = {}
    for key, name in entries:
        try:
            which = whole(int(key) if isinstance(key, str) else key, 0, MAX_ID)
        except ValueError as error:
            raise InputError(f"{path}: a label's id is not usable ({str(error)[:LONGEST]}); correct it") from None
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{path}: label {which} has {shortened(name)} for a name; give a text that is not empty")
        names[which] = name
    return names


def indexed(
    raw: np.ndarray, names: dict[int, str] | None, class_names: tuple[str, ...] | None
) -> tuple[np.ndarray, list[str], list[str]]:
    """Raw ids [V, H, W] (-1: none) as indices i16 into class names; the names, and notes on what became -1.

    Choices: the classes are those that occur, in the order of their ids, or `class_names` where given. Ids are named
      by `names`, else by their place in `class_names`, else class_<id> with 0 ignored.
    Raises:  DataFailure if nothing is left.
    """
    counts = sum(np.bincount(view.ravel() + 1, minlength=MAX_ID + 2) for view in raw)
    present = [int(v) for v in np.flatnonzero(counts) - 1 if v >= 0]
    known = names if names is not None else dict(enumerate(class_names or ()))
    if names is None and class_names is None:
        known = {v: f"class_{v}" for v in present if v != 0}
    named = {v: known[v] for v in present if v in known and known[v].lower() not in IGNORED}
    result = list(class_names or dict.fromkeys(named.values()))
    notes = []
    if nameless := [str(v) for v in present if v not in known and v != 0]:
        notes.append(f"Label ids without a name are ignored: {', '.join(nameless)}.")
    if foreign := sorted(set(named.values()) - set(result)):
        notes.append(f"Labels that are not among the class names are ignored: {', '.join(foreign)}.")
    table = np.full(MAX_ID + 2, -1, np.int16)
    for value, name in named.items():
        table[value + 1] = result.index(name) if name in result else -1
    if (table < 0).all():
        raise DataFailure(f"no label has a name (ids {present[:8]}); give names, or take the labels away")
    labels = np.empty(raw.shape, np.int16)
    for k, view in enumerate(raw):  # one by one: a copy of all would be the largest thing in memory
        labels[k] = table[view + 1]
    return labels, result, notes
