"""`features/1`: per-view semantic features of a 2D teacher, and the labels they can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, has_array, open_array, write_array
from chebsplat.formats.documents import read_document, write_document
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.features/1"


@dataclass
class Features:
    """Features of V views at the teacher's resolution h x w.

    names:            of the views, for joins.
    features:         f16 [V, h, w, C].
    label_names:      L names; label_embeddings: f32 [L, C] unit rows; a pixel's label is the largest cosine.
    pseudo_labels:    i16 [V, h, w] or None; confidence: f16 [V, h, w] in [0, 1] or None.
    convention:       n_scales, flips, normalized and the teacher's own parameters: a loss needs to know them.
    """

    names: list[str]
    features: np.ndarray | StoredArray
    label_names: list[str]
    label_embeddings: np.ndarray
    pseudo_labels: np.ndarray | StoredArray | None = None
    confidence: np.ndarray | StoredArray | None = None
    convention: dict[str, Any] = field(default_factory=dict)


def write_features(out: Path, features: Features) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    data = np.asarray(features.features)
    if not np.isfinite(data).all():
        raise ValueError(f"features hold {np.sum(~np.isfinite(data))} non-finite values")
    write_array(out / "features", data.astype(np.float16, copy=False), ("view", "row", "column", "channel"))
    if features.pseudo_labels is not None:
        labels = np.asarray(features.pseudo_labels).astype(np.int16, copy=False)
        write_array(out / "pseudo_labels", labels, ("view", "row", "column"), "label index")
    if features.confidence is not None:
        confidence = np.asarray(features.confidence).astype(np.float16, copy=False)
        write_array(out / "confidence", confidence, ("view", "row", "column"))
    write_tensors(out / "labels.safetensors", {"embeddings": features.label_embeddings.astype(np.float32)})
    write_document(
        out / "features.json",
        {"names": features.names, "label_names": features.label_names, "convention": features.convention},
    )


def read_features(path: Path) -> Features:
    """Features stay on disk until indexed. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document = read_document(path, manifest, "features.json", ("names", "label_names", "convention"))
    names, label_names = document["names"], document["label_names"]
    features = open_array(path, manifest, "features", (len(names), None, None, None), "float16")
    shape = {"embeddings": (len(label_names), features.shape[3])}
    embeddings = read_tensors(path, manifest, "labels.safetensors", shape)["embeddings"]
    optional = {
        name: open_array(path, manifest, name, features.shape[:3], dtype) if has_array(manifest, name) else None
        for name, dtype in (("pseudo_labels", "int16"), ("confidence", "float16"))
    }
    lengths = np.linalg.norm(embeddings, axis=1)
    if not np.allclose(lengths, 1, atol=1e-3):
        raise InputError(f"{path / 'labels.safetensors'}: embeddings are not unit vectors; {artifact.remedy(path)}")
    return Features(names, features, label_names, embeddings, **optional, convention=document["convention"])
