"""Images of label ids: raw ids of a frame, and what they mean as indices into class names."""

from __future__ import annotations

import numpy as np

from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.pictures import GREY, companion

IGNORED = {"void", "ignore", "ignored", "unlabeled", "unlabelled", "undefined", "unknown"}
MAX_ID = 65_535


def label_ids(frame: Frame, listing: Listing, size: tuple[int, int]) -> np.ndarray:
    """Raw ids i32 [h, w] of a frame's label image, its corrected objects replaced. InputError beyond MAX_ID."""
    assert frame.labels is not None
    ids = companion(frame.labels, size, GREY, "8- or 16-bit ids", listing.any_label_size).astype(np.int32)
    if ids.max() > MAX_ID:
        raise InputError(f"{frame.labels} holds id {ids.max()}; ids up to {MAX_ID} are supported")
    if frame.objects is not None and listing.corrections:
        objects = companion(frame.objects, ids.shape[::-1], GREY, "8- or 16-bit ids")
        for which, value in listing.corrections.items():
            ids[objects == which] = value
    return ids


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
