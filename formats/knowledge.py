"""`knowledge/1`: a point encoder taught over many rooms, for one teacher, and the card that says on what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.knowledge/1"
ENCODER = "encoder.onnx"  # the same encoder, for onnxruntime; the stage writes it
SHIPPED = Path(__file__).parents[1] / "teachers/knowledge"  # of the embedded teacher; ships with the package


@dataclass
class Knowledge:
    """What a scene starts from.

    teacher:  its name; digest: of its files, as in `channels/2`.
    encoder:  constructor settings of the point encoder; weights: its arrays by name.
    matrix:   f32 [C, d], from the teacher's C channels to the d that the encoder answers in; columns orthonormal.
    describe: settings of the descriptors that it sees.
    words:    W that it can name things by; embeddings f16 [W, d] of these, unit in the teacher's channels.
    card:     rooms, views, steps, errors on rooms held out, and where it fails.
    """

    teacher: str
    digest: str
    encoder: dict[str, int]
    weights: dict[str, np.ndarray]
    matrix: np.ndarray
    describe: dict[str, Any]
    words: list[str]
    embeddings: np.ndarray
    card: dict[str, Any]


def write_knowledge(out: Path, knowledge: Knowledge) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_tensors(out / "weights.safetensors", knowledge.weights)
    write_tensors(out / "channels.safetensors", {"matrix": knowledge.matrix, "embeddings": knowledge.embeddings})
    names = ("teacher", "digest", "encoder", "describe", "words", "card")
    write_document(out / "knowledge.json", {name: getattr(knowledge, name) for name in names})


def read_card(path: Path) -> dict[str, Any]:
    """All but the arrays. Raises InputError naming the damaged file and the remedy."""
    card: dict[str, Any] = read_document(path, artifact.read_manifest(path, SCHEMA), "knowledge.json")
    return card


def read_knowledge(path: Path) -> Knowledge:
    """The knowledge at `path`. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document = read_document(path, manifest, "knowledge.json")
    weights = read_tensors(path, manifest, "weights.safetensors")
    specs: dict[str, tuple[str | int, ...]] = {"matrix": ("float32", "C", "d"), "embeddings": ("float16", "W", "d")}
    channels = read_tensors(path, manifest, "channels.safetensors", specs)
    return Knowledge(**document, weights=weights, matrix=channels["matrix"], embeddings=channels["embeddings"])
