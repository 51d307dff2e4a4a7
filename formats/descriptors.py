"""`descriptors/1`: regions of the initial Gaussians and their anisotropic Chebyshev descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.descriptors/1"
SPECS: dict[str, Spec] = {
    "centers": ("int64", "m"),
    "members": ("int64", "m", "n"),
    "values": ("float32", "m", "n", "j", "d"),
}


@dataclass
class Descriptors:
    """centers: i64 [M] indices of the points that regions are centred on. members: i64 [M, n], -1 where padded.
    values: f32 [M, n, J, P], zero where padded; P = D - 1 degrees. settings: the parameters they were
    computed with, and the regions' radius and share.
    """

    centers: np.ndarray
    members: np.ndarray
    values: np.ndarray
    settings: dict[str, Any]


def write_descriptors(out: Path, descriptors: Descriptors) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    arrays = {name: getattr(descriptors, name) for name in SPECS}
    write_tensors(out / "descriptors.safetensors", arrays)
    write_document(out / "settings.json", descriptors.settings)


def read_descriptors(path: Path) -> Descriptors:
    """Regions and descriptors at `path`, all in memory. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    arrays = read_tensors(path, manifest, "descriptors.safetensors", SPECS)
    settings = read_document(path, manifest, "settings.json")
    return Descriptors(**{name: arrays[name] for name in SPECS}, settings=settings)
