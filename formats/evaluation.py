"""`evaluation/1`: figures per view and per class, rendered pictures, timings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, has_array, open_array, write_array
from chebsplat.formats.documents import read_document, write_document

SCHEMA = "chebsplat.evaluation/1"
PICTURES = {"truth": "uint8", "renders": "uint8", "labels": "int16", "predicted": "int16", "teacher": "int16"}


@dataclass
class Evaluation:
    """figures: everything measured, JSON-able, `None` where it was not measured (never 0).
    pictures: by name in PICTURES, one entry a test view: `truth`, `renders` u8 [V,H,W,3]; label maps i16 [V,H,W].
    """

    figures: dict[str, Any]
    pictures: dict[str, np.ndarray | StoredArray] = field(default_factory=dict)


def write_evaluation(out: Path, evaluation: Evaluation) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a figure that is nan or infinite."""
    write_document(out / "figures.json", evaluation.figures)
    for name, data in evaluation.pictures.items():
        dimensions = ("view", "row", "column", "channel")[: data.ndim]  # type: ignore[union-attr]
        write_array(out / name, np.asarray(data).astype(PICTURES[name], copy=False), dimensions)


def read_evaluation(path: Path) -> Evaluation:
    """Raises: InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    pictures: dict[str, np.ndarray | StoredArray] = {}
    for name, dtype in PICTURES.items():
        if has_array(manifest, name):
            shape = (None, None, None, 3) if dtype == "uint8" else (None, None, None)
            pictures[name] = open_array(path, manifest, name, shape, dtype)
    return Evaluation(read_document(path, manifest, "figures.json"), pictures)
