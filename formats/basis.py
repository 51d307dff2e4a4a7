"""`basis/1`: one revision of the core knowledge space; revisions form an append-only chain."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.basis/1"


@dataclass
class Basis:
    """`bases[name]` [q, r] has orthonormal columns; `weights[name]` [q, p] is the encoder's own matrix beside it.

    `lineage` holds one entry a revision, the oldest first: scene, key, rank and residual before and after.
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
    (out / "lineage.json").write_text(json.dumps(basis.lineage, indent=1) + "\n")


def read_basis(path: Path) -> Basis:
    """Raises: InputError naming the damaged file, or a basis whose columns are not orthonormal to 1e-5."""
    manifest = artifact.read_manifest(path, SCHEMA)
    bases = read_tensors(path, manifest, "bases.safetensors")
    weights = read_tensors(path, manifest, "weights.safetensors")
    for name, columns in bases.items():
        error = np.abs(columns.T.astype(np.float64) @ columns - np.eye(columns.shape[1])).max(initial=0.0)
        if error > 1e-5:
            raise InputError(
                f"{path / 'bases.safetensors'}: {name} is not orthonormal ({error:.1e}); {artifact.remedy(path)}"
            )
    return Basis(bases, weights, json.loads(artifact.checked(path, manifest, "lineage.json").read_text()))
