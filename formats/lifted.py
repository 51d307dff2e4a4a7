"""`lifted/1`: features that were lifted to the Gaussians of a checkpoint, and the evidence for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.documents import Count, TypedDict, read_document, write_document
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.lifted/1"
SPECS: dict[str, Spec] = {
    "features": ("float32", "n", "c"),
    "weights": ("float32", "n"),
    "n_views": ("int32", "n"),
    "agreement": ("float32", "n"),
    "halves": ("float32", 2, "n", "c"),
    "half_views": ("int32", 2, "n"),
}


class Notes(TypedDict):
    views: list[str]
    n_observations: Count


@dataclass
class Lifted:
    """N Gaussians in the order of their checkpoint, C channels of the teacher.

    features:   f32 [N, C]; zero where no training view sees a Gaussian.
    weights:    f32 [N], pixels: Σ α T over all training views.
    n_views:    i32 [N], training views that see it.
    agreement:  f32 [N] in [0, 1]: length of the weighted mean of the views' directions; 1: all say the same.
    halves:     f32 [2, N, C], features by each half of the training views; half_views i32 [2, N], how many see it.
    notes:      names of the views, in order, and the number of observations.
    """

    features: np.ndarray
    weights: np.ndarray
    n_views: np.ndarray
    agreement: np.ndarray
    halves: np.ndarray
    half_views: np.ndarray
    notes: dict[str, Any] = field(default_factory=dict)


def write_lifted(out: Path, lifted: Lifted) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_tensors(out / "lifted.safetensors", {name: getattr(lifted, name) for name in SPECS})
    write_document(out / "notes.json", lifted.notes)


def read_lifted(path: Path) -> Lifted:
    """Lifted features at `path`, all in memory. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    arrays = read_tensors(path, manifest, "lifted.safetensors", SPECS)
    low = min(arrays[name].min(initial=0) for name in ("weights", "n_views", "agreement", "half_views"))
    if low < 0 or arrays["agreement"].max(initial=0) > 1 + 1e-4:
        raise InputError(
            f"{path / 'lifted.safetensors'}: a weight or a count is negative, or an agreement is not in [0, 1]; "
            + remedy_of(path)
        )
    return Lifted(**{name: arrays[name] for name in SPECS}, notes=read_document(path, manifest, "notes.json", Notes))
