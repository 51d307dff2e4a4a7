"""Texts of a source: JSON objects, tables and matrices; InputError names a file that is faulty."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import parse_json, read_text

LEAST_SKEW = 0.01  # pixels
LONGEST = 80  # characters of a value that a message repeats
# bytes of a table: 20,000 poses at full precision; its words take up to 60 times as much memory
LARGEST = 8 << 20


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError."""
    document = parse_json(path)
    if not isinstance(document, dict):
        raise InputError(
            f"{path} holds a {type(document).__name__}, not an object; restore the file"
        )
    return document


def number(value: Any) -> float:
    """A finite number. Raises ValueError on text, true, null, inf, nan and beyond float64."""
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        try:
            if math.isfinite(real := float(value)):
                return real
        except OverflowError:
            pass
    raise ValueError(shortened(value))


def whole(value: Any, least: int, most: int) -> int:
    """A whole number in least...most. Raises ValueError on anything else."""
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{shortened(value)} is no whole number in {least}...{most}")
    return value


def shortened(value: Any) -> str:
    """A value for a message: on one line, and cut where long."""
    text = (
        f"{value:.6g}"
        if isinstance(value, float)
        else repr(value)
        if isinstance(value, (str, bool))
        else ""
    )
    text = text or type(value).__name__
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def read_rows(path: Path) -> list[list[str]]:
    """The words of each line that has any. Raises InputError."""
    return [
        words for line in read_text(path, largest=LARGEST).splitlines() if (words := line.split())
    ]


def read_matrix(path: Path) -> np.ndarray:
    """A 4x4 matrix f64 of a text file; 3x3 and 3x4 matrices are completed. Raises InputError."""
    try:
        rows = [[float(v) for v in row] for row in read_rows(path)]
    except ValueError as error:
        raise InputError(
            f"{path} does not hold numbers ({str(error)[:LONGEST]}); restore the file"
        ) from None
    if len(rows) not in (3, 4) or {len(row) for row in rows} not in ({3}, {4}):
        raise InputError(f"{path} does not hold a 3x3 or 4x4 matrix; restore the file")
    matrix = np.eye(4)
    matrix[: len(rows), : len(rows[0])] = rows
    return matrix


def skew_note(path: Path, K: np.ndarray) -> list[str]:
    """A note on a skew in intrinsics that is not used; none below LEAST_SKEW."""
    note = (
        f"{path.name} has a skew of {K[0, 1]:g} pixels, which is not used: pixels are taken as "
        "rectangular."
    )
    return [note] if abs(K[0, 1]) > LEAST_SKEW else []


def read_table(path: Path, remedy: str) -> list[dict[str, str]]:
    """Rows of a tab-separated table by the names of its first line. Raises InputError."""
    try:
        return list(
            csv.DictReader(
                io.StringIO(read_text(path, remedy, largest=LARGEST // 4), newline=""),
                delimiter="\t",
            )
        )
    except csv.Error as error:
        raise InputError(f"{path} is no table ({error}); {remedy}") from None
