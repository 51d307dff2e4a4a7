"""`channels/1`: the linear map from a teacher's channels to the fewer that scenes are trained in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.documents import TypedDict, read_document, write_document
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.channels/1"
SPECS: dict[str, Spec] = {"matrix": ("float32", "C", "d"), "inverse": ("float32", "d", "C"), "energy": ("float32", "C")}


class Document(TypedDict):
    teacher: str
    notes: dict[str, Any]


@dataclass
class ChannelMap:
    """The linear map from a teacher's C channels to d; one for all scenes, computed by `chebsplat.labels.channels`.

    matrix:  f32 [C, d] orthonormal columns, of falling weight.
    inverse: f32 [d, C], back to the teacher's channels.
    energy:  f32 [C] share of the reference's squared length that the first k + 1 directions hold.
    teacher: its name.
    notes:   the teacher's digest, what the reference was, numbers of its pixels and of the vocabulary's words.
    """

    matrix: np.ndarray
    inverse: np.ndarray
    energy: np.ndarray
    teacher: str
    notes: dict[str, Any]

    def apply(self, features: np.ndarray) -> np.ndarray:
        """Features [..., C] -> f32 [..., d]."""
        mapped: np.ndarray = np.asarray(features, np.float32) @ self.matrix
        return mapped

    def embed(self, embeddings: np.ndarray) -> np.ndarray:
        """Unit embeddings [L, C] of words -> f32 [L, d].

        Choices: not made unit again, so that an inner product with mapped features is the teacher's own; unit
          rows would favour the words that the reference shows least.
        """
        embedded: np.ndarray = np.asarray(embeddings, np.float32) @ self.matrix
        return embedded

    def restore(self, features: np.ndarray) -> np.ndarray:
        """Mapped features [..., d] -> f32 [..., C]."""
        restored: np.ndarray = np.asarray(features, np.float32) @ self.inverse
        return restored


def tensors(channels: ChannelMap) -> dict[str, np.ndarray]:
    """The arrays of a channel map by name, float32."""
    return {name: getattr(channels, name).astype(np.float32) for name in SPECS}


def from_parts(arrays: Mapping[str, np.ndarray], document: Mapping[str, Any]) -> ChannelMap:
    """The channel map whose arrays and document these are, read elsewhere."""
    return ChannelMap(**{name: arrays[name] for name in SPECS}, teacher=document["teacher"], notes=document["notes"])


def write_channels(out: Path, channels: ChannelMap) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_tensors(out / "channels.safetensors", tensors(channels))
    write_document(out / "channels.json", {"teacher": channels.teacher, "notes": channels.notes})


def read_channels(path: Path) -> ChannelMap:
    """Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    arrays = read_tensors(path, manifest, "channels.safetensors", SPECS)
    return from_parts(arrays, read_document(path, manifest, "channels.json", Document))
