"""`knowledge/4`: an encoder of shape, and the map from its features to meaning."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.lesson import SPECS as SUMS
from chebsplat.formats.lesson import PlainSums, packed, unpacked
from chebsplat.formats.tensors import Spec, read_tensors, write_tensors

SCHEMA = "chebsplat.knowledge/4"
# of the embedded teacher; ships with the package
SHIPPED = Path(__file__).parents[1] / "teachers/knowledge"
SPECS: dict[str, Spec] = {"matrix": ("float32", "C", "d"), "embeddings": ("float16", "W", "d"),
                          "map": ("float32", "p", "d"), "basis": ("float32", "p", "r"),
                          "scale": ("float32", "p"),
                          "class_means": ("float32", "K", "p")}  # fmt: skip


@dataclass
class Knowledge:
    """A point encoder and its linear map to meaning, from which the knowledge of a scene starts.

    teacher:    its name; digest: of its files, as in `channels/2`.
    encoder:    constructor settings of the point encoder; weights: its arrays by name.
    matrix:     f32 [C, d], from the teacher's C channels to d; columns orthonormal.
    describe:   settings of the descriptors that the encoder reads.
    words:      W words of the vocabulary; embeddings f16 [W, d], unit before `matrix`.
    map:        f32 [p, d], from features of shape to the embeddings of words.
    basis:      f32 [p, r], of features times scale f32 [p]: the subspace learned so far (Eq 15).
    classes:    K classes that it was taught; class_means f32 [K, p], the mean features of shape of
      each, by which the classes are found that shape does not tell apart.
    card:       training facts; for each kind of room held out, the shares of points named right
      (`stages.teach.measure_accuracy`) and, in `novelty`, the largest ρ′.
    lessons:    the lessons it was solved from, in `of`: of each its key, scene, trust, the reason,
      and whether it is new in kind. Empty in what ships.
    shipped:    mean sums of the generated rooms, by parts of them; none in what a scene has solved.
    """

    teacher: str
    digest: str
    encoder: dict[str, Any]
    weights: dict[str, np.ndarray]
    matrix: np.ndarray
    describe: dict[str, Any]
    words: list[str]
    embeddings: np.ndarray
    map: np.ndarray
    basis: np.ndarray
    scale: np.ndarray
    classes: list[str]
    class_means: np.ndarray
    card: dict[str, Any]
    lessons: dict[str, Any] = field(default_factory=dict)
    shipped: list[PlainSums] = field(default_factory=list)


DOCUMENT = ("teacher", "digest", "encoder", "describe", "words", "classes", "card", "lessons")


def write_knowledge(out: Path, knowledge: Knowledge) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on nan or infinity."""
    write_tensors(out / "weights.safetensors", knowledge.weights)
    write_tensors(out / "answers.safetensors", {name: getattr(knowledge, name) for name in SPECS})
    for number, sums in enumerate(knowledge.shipped):
        write_tensors(out / f"shipped{number}.safetensors", packed(sums))
    squares = [square for *_, square in knowledge.shipped]
    document = {name: getattr(knowledge, name) for name in DOCUMENT} | {"squares": squares}
    write_document(out / "knowledge.json", document)


def read_card(path: Path) -> dict[str, Any]:
    """All but the arrays. Raises InputError naming the damaged file and the remedy."""
    card: dict[str, Any] = read_document(
        path, artifact.read_manifest(path, SCHEMA), "knowledge.json"
    )
    return card


def read_knowledge(path: Path) -> Knowledge:
    """The knowledge at `path`. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document: dict[str, Any] = read_document(path, manifest, "knowledge.json")
    shipped = [
        unpacked(read_tensors(path, manifest, f"shipped{number}.safetensors", SUMS), square)
        for number, square in enumerate(document.pop("squares"))
    ]
    weights = read_tensors(path, manifest, "weights.safetensors")
    arrays = read_tensors(path, manifest, "answers.safetensors", SPECS)
    values: dict[str, Any] = document | arrays
    return Knowledge(**values, weights=weights, shipped=shipped)
