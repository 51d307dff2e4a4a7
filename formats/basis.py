"""`basis/3`: one revision of the core knowledge space; revisions form an append-only chain."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.documents import Count, TypedDict, read_document, write_document
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.basis/3"
ORTHONORMAL = 1e-6


class Report(TypedDict):
    """Of `cks.update`."""

    rank_before: Count
    rank_after: Count
    added: Count
    rho: float
    rho_after: float
    rho_printed: float
    energy: float


class Entry(TypedDict):
    scene: str
    gaussians: str
    spread: float
    maps: dict[str, Report]


@dataclass
class Basis:
    """`bases[name]` [q, r] has orthonormal columns that span inputs of the encoder's linear map W [q, p].

    `weights` are the encoder's own arrays beside them (its `nn.Linear.weight` is Wᵀ). `lineage` holds one entry a
    revision, the oldest first: `scene`, `gaussians` (the checkpoint's key), `spread` (its σ_f), and `maps`: by name the
    report of `cks.update`. The scene's columns are those from `rank_before` to `rank_after`; a map that the scene's
    encoder lacks, or has for other inputs, has no report.
    """

    bases: dict[str, np.ndarray]
    weights: dict[str, np.ndarray]
    lineage: list[dict[str, Any]] = field(default_factory=list)

    @property
    def revision(self) -> int:
        return len(self.lineage)


def write_basis(out: Path, basis: Basis) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_tensors(out / "bases.safetensors", basis.bases)
    write_tensors(out / "weights.safetensors", basis.weights)
    write_document(out / "lineage.json", basis.lineage)


def read_basis(path: Path) -> Basis:
    """Raises: InputError naming the damaged file, or a basis that is not orthonormal or not what its lineage says."""
    manifest = artifact.read_manifest(path, SCHEMA)
    bases = read_tensors(path, manifest, "bases.safetensors")
    weights = read_tensors(path, manifest, "weights.safetensors")
    lineage = read_lineage(path)
    file = path / "bases.safetensors"
    for name, columns in bases.items():
        if columns.ndim != 2 or columns.dtype != np.float32:
            raise InputError(f"{file}: {name} is no float32 matrix; {remedy_of(path)}")
        if (error := off_orthonormal(columns)) > ORTHONORMAL:
            raise InputError(f"{file}: {name} is not orthonormal ({error:.1e}); {remedy_of(path)}")
        rank = last_report(lineage, name)["rank_after"]
        if rank != columns.shape[1]:
            raise InputError(f"{file}: {name} has {columns.shape[1]} columns, its lineage {rank}; {remedy_of(path)}")
    return Basis(bases, weights, lineage)


def last_report(lineage: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Of the last scene that had the linear map `name`; ranks are 0 where none had."""
    reports = (entry["maps"][name] for entry in reversed(lineage) if name in entry["maps"])
    return next(reports, {"rank_before": 0, "rank_after": 0, "added": 0})


def off_orthonormal(columns: np.ndarray) -> float:
    """Largest entry of |BᵀB − I| of columns [q, r], in float64."""
    return float(np.abs(columns.T.astype(np.float64) @ columns - np.eye(columns.shape[1])).max(initial=0.0))


def read_lineage(path: Path) -> list[dict[str, Any]]:
    """The lineage alone. Raises InputError naming file and remedy."""
    manifest = artifact.read_manifest(path, SCHEMA)
    entries: list[dict[str, Any]] = read_document(path, manifest, "lineage.json", list[Entry])
    return entries
