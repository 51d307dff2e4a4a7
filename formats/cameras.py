"""Cameras that travel with a scene: a reader can render it without the capture it came from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chebsplat.formats.artifact import Manifest
from chebsplat.formats.documents import read_document, write_document
from chebsplat.formats.tensors import read_tensors, write_tensors


@dataclass
class Cameras:
    """names of V views; Ks f64 [V, 3, 3] pixels of a width x height image; cam_from_world f64 [V, 4, 4]."""

    names: list[str]
    Ks: np.ndarray
    cam_from_world: np.ndarray
    width: int
    height: int


def write_cameras(out: Path, cameras: Cameras) -> None:
    write_tensors(out / "cameras.safetensors", {"Ks": cameras.Ks, "cam_from_world": cameras.cam_from_world})
    document = {"names": cameras.names, "width": cameras.width, "height": cameras.height}
    write_document(out / "cameras.json", document)


def read_cameras(path: Path, manifest: Manifest) -> Cameras:
    """Raises: InputError naming the damaged file and the remedy."""
    document = read_document(path, manifest, "cameras.json", ("names", "width", "height"))
    n = len(document["names"])
    arrays = read_tensors(path, manifest, "cameras.safetensors", {"Ks": (n, 3, 3), "cam_from_world": (n, 4, 4)})
    return Cameras(document["names"], arrays["Ks"], arrays["cam_from_world"], document["width"], document["height"])
