"""`basis/3`: one revision of the core knowledge space; revisions form an append-only chain."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.basis/3"


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
    """The basis at `path`. Raises InputError naming the damaged file and the remedy."""
    manifest = artifact.read_manifest(path, SCHEMA)
    bases = read_tensors(path, manifest, "bases.safetensors")
    weights = read_tensors(path, manifest, "weights.safetensors")
    return Basis(bases, weights, read_lineage(path))


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
    entries: list[dict[str, Any]] = read_document(path, manifest, "lineage.json")
    return entries
