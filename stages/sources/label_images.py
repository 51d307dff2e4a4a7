"""Images of label ids: raw ids of a frame, and what they mean as indices into class names."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.pictures import GREY, companion
from chebsplat.stages.sources.texts import LONGEST, shortened, whole

IGNORED = {"void", "ignore", "ignored", "unlabeled", "unlabelled", "undefined", "unknown"}
MAX_ID = 65_535  # what 16 bits hold


def label_ids(frame: Frame, listing: Listing, size: tuple[int, int], at: np.ndarray) -> np.ndarray:
    """Raw ids i32 [H, W] at positions `at` [2, H, W] of a frame's label image, its corrected objects replaced."""
    assert frame.labels is not None
    ids = companion(frame.labels, size, at, GREY, "8- or 16-bit ids", listing.any_label_size).astype(np.int32)
    if frame.objects is not None and listing.corrections:
        objects = companion(frame.objects, size, at, GREY, "8- or 16-bit ids", listing.any_label_size)
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
