"""ScanNet's label ids as class names, in the two ways in use: column `cocomapid`, and 40 NYU classes reduced."""

from __future__ import annotations

from pathlib import Path

from chebsplat.errors import InputError
from chebsplat.evaluation.protocols import scannet_closed, scannet_open
from chebsplat.stages.sources.common import present
from chebsplat.stages.sources.texts import LONGEST, read_table

MODIFIED, COMBINED = "scannetv2-labels.modified.tsv", "scannet-labels.combined.tsv"
OTHER = "otherprop"  # SG's id 0: known and ignored
CORRECTED = 60_000  # plus an NYU class: raw ids of hand-corrected objects, above all of ScanNet's

# Objects that the authors of Panoptic Lifting relabel by hand, as ScanNet has them wrong: object id -> NYU class.
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


def mapped(path: Path | None) -> dict[int, str]:
    """Class names by raw id through the table's column `cocomapid`; 0 is `otherprop`, which is no class."""
    names = (OTHER, *scannet_open.CLASSES)
    return {raw: names[value] for raw, value in _column(path, MODIFIED, "cocomapid", len(names)).items()}


def reduced(path: Path | None, scene: str) -> tuple[dict[int, str], dict[int, int]]:
    """Class names by raw id through the table's column `nyu40id`, and the scene's corrections by object id.

    Choices: an id whose `nyu40id` is empty is NYU's 40, other props; 0 is void.
    """
    nyu = _column(path, COMBINED, "nyu40id", 41, empty=40)
    names = {raw: scannet_closed.REDUCED[value] for raw, value in nyu.items()} | {0: "void"}
    fixes = CORRECTIONS.get(scene, {})
    names |= {CORRECTED + value: scannet_closed.REDUCED[value] for value in fixes.values()}
    return names, {which: CORRECTED + value for which, value in fixes.items()}


def _column(path: Path | None, name: str, column: str, n_values: int, empty: int | None = None) -> dict[int, int]:
    """A column of whole numbers below `n_values`, by the column `id`; of an id listed twice the last row counts."""
    if path is None or not present(path):
        raise InputError(f"{path} is missing; put {name} into the scene's folder or one above it")
    rows = read_table(path, f"take {name}")
    try:
        found = {int(row["id"]): int(row[column]) if row[column] or empty is None else empty for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        reason = str(error)[:LONGEST]
        raise InputError(f"{path} has no usable columns id and {column} ({reason}); take {name}") from None
    if not found or min(found) < 0 or not all(0 <= value < n_values for value in found.values()):
        raise InputError(
            f"{path}: ids must not be negative, and values of {column} must lie in 0...{n_values - 1}; take {name}"
        )
    return found
