"""`refined/1`: the features of a finished scene after smoothing and knowledge, and how both were chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.documents import NotRequired, TypedDict, read_document, write_document
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.refined/1"
SPECS: dict[str, Spec] = {"features": ("float32", "n", "c"), "confidence": ("float32", "n")}
Agreement = Annotated[float, Ge(-1.001), Le(1.001)]


class Notes(TypedDict):
    start: Literal["trained", "lifted", "both"]
    smooth: bool
    strength: Annotated[float, Ge(0), Le(1e6)]
    familiar: NotRequired[Annotated[float, Ge(0), Le(1)]]
    curve: dict[Literal["off", "on"], dict[str, Agreement]]


@dataclass
class Refined:
    """N Gaussians in the order of their checkpoint, C channels of the teacher.

    features:   f32 [N, C].
    confidence: f32 [N] in [0, 1]: how many votes there are and how far they agree; 0 where nothing is known.
    notes:      what it started from, whether it was smoothed, views that knowledge counts for, what a view counts for
                where the teacher is unsure of the scene, and by smoothing and strength the agreement of half the
                training views with the other half.
    """

    features: np.ndarray
    confidence: np.ndarray
    notes: dict[str, Any] = field(default_factory=dict)


def write_refined(out: Path, refined: Refined) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_tensors(out / "refined.safetensors", {name: getattr(refined, name) for name in SPECS})
    write_document(out / "notes.json", refined.notes)


def read_refined(path: Path) -> Refined:
    """Refined features at `path`, all in memory. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    arrays = read_tensors(path, manifest, "refined.safetensors", SPECS)
    confidence = arrays["confidence"]
    if confidence.min(initial=0) < 0 or confidence.max(initial=0) > 1 + 1e-4:
        raise InputError(f"{path / 'refined.safetensors'}: a confidence is not in [0, 1]; {remedy_of(path)}")
    return Refined(**{name: arrays[name] for name in SPECS}, notes=read_document(path, manifest, "notes.json", Notes))
