"""`lesson/2`: normal-equation sums over one scene's points, and evidence for their trust."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.lesson/2"
# `shape.lessons.Sums`, which formats do not import: A f64 [p, p], b f64 [p, d] and c
PlainSums = tuple[np.ndarray, np.ndarray, float]
SPECS: dict[str, Spec] = {"gram": ("float32", "half"), "cross": ("float32", "p", "d")}


@dataclass
class Lesson:
    """sums: of the scene's points. notes: scene, teacher, points, words, ρ, σ_f, ρ′; evidence for
    trust (labels given, `familiar`, share of labels common to shape and teacher).
    """

    sums: PlainSums
    notes: dict[str, Any]


def packed(sums: PlainSums) -> dict[str, np.ndarray]:
    """The lower half of A row by row, and b, f32."""
    gram, cross, _ = sums
    return {
        "gram": gram[np.tril_indices(len(gram))].astype(np.float32),
        "cross": cross.astype(np.float32),
    }


def unpacked(arrays: dict[str, np.ndarray], square: float) -> PlainSums:
    """Sums from the arrays of `packed`. Raises ValueError where the sizes do not fit."""
    p = len(arrays["cross"])
    gram = np.zeros((p, p))
    gram[np.tril_indices(p)] = arrays["gram"]
    return gram + np.tril(gram, -1).T, arrays["cross"].astype(np.float64), square


def write_lesson(out: Path, lesson: Lesson) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on nan or infinity."""
    write_tensors(out / "sums.safetensors", packed(lesson.sums))
    write_document(out / "lesson.json", {"square": lesson.sums[2]} | lesson.notes)


def read_lesson(path: Path) -> Lesson:
    """The lesson at `path`. Raises InputError naming the damaged file and the remedy."""
    manifest = artifact.read_manifest(path, SCHEMA)
    notes = read_document(path, manifest, "lesson.json")
    return Lesson(
        unpacked(read_tensors(path, manifest, "sums.safetensors", SPECS), notes.pop("square")),
        notes,
    )


def read_notes(path: Path) -> dict[str, Any]:
    """All of a lesson but its sums. Raises InputError naming the damaged file and the remedy."""
    notes: dict[str, Any] = read_document(path, artifact.read_manifest(path, SCHEMA), "lesson.json")
    return notes
