"""Cameras that travel with a scene: a reader can render it without the capture it came from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.documents import Side, TypedDict, read_document, write_document
from chebsplat.formats.manifest import Manifest, remedy_of
from chebsplat.formats.names import check_names
from chebsplat.formats.tensors import FLOAT, Spec, read_tensors, write_tensors

POSES: dict[str, Spec] = {"Ks": (FLOAT, "v", 3, 3), "cam_from_world": (FLOAT, "v", 4, 4)}
RIGID = 1e-3  # largest entry of |RRᵀ − I|


@dataclass
class Cameras:
    """names of V views; Ks f64 [V, 3, 3] pixels of a width x height image; cam_from_world f64 [V, 4, 4]."""

    names: list[str]
    Ks: np.ndarray
    cam_from_world: np.ndarray
    width: int
    height: int


class Document(TypedDict):
    names: list[str]
    width: Side
    height: Side


def write_cameras(out: Path, cameras: Cameras) -> None:
    """Write cameras beside what else an artifact holds. Raises ValueError on a non-finite value."""
    write_tensors(out / "cameras.safetensors", {"Ks": cameras.Ks, "cam_from_world": cameras.cam_from_world})
    document = {"names": cameras.names, "width": cameras.width, "height": cameras.height}
    write_document(out / "cameras.json", document)


def read_cameras(path: Path, manifest: Manifest) -> Cameras:
    """The cameras of an artifact. Raises InputError naming the damaged file and the remedy."""
    document, file = read_document(path, manifest, "cameras.json", Document), path / "cameras.safetensors"
    names = document["names"]
    check_names(names, "names", path / "cameras.json", remedy_of(path))
    arrays = read_tensors(path, manifest, file.name, POSES)
    check_cameras(names, arrays["Ks"], arrays["cam_from_world"], file, remedy_of(path))
    return Cameras(names, arrays["Ks"], arrays["cam_from_world"], document["width"], document["height"])


def check_cameras(names: list[str], Ks: np.ndarray, poses: np.ndarray | None, where: object, remedy: str) -> None:
    """Raise InputError naming the first view whose camera cannot be used; poses [V, 4, 4] of a world, or None."""
    for what, data in (("Ks", Ks), ("poses", poses)):
        if data is not None and len(data) != len(names):
            raise InputError(f"{where}: {len(data)} {what} for {len(names)} views; {remedy}")
    usable = np.isfinite(Ks).all((1, 2)) & (Ks[:, 0, 0] > 0) & (Ks[:, 1, 1] > 0) & (Ks[:, 2] == [0, 0, 1]).all(1)
    if not usable.all():
        raise InputError(f"{where}: the intrinsics of {names[int(np.argmin(usable))]} are not a camera's; {remedy}")
    if poses is None:
        return
    rotations = np.nan_to_num(poses[:, :3, :3], nan=np.inf).clip(-2, 2)
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
    rigid = (off < RIGID) & (np.linalg.det(rotations) > 0) & np.isfinite(poses).all((1, 2))
    rigid &= (poses[:, 3] == [0, 0, 0, 1]).all(1)
    if not rigid.all():
        raise InputError(f"{where}: the pose of {names[int(np.argmin(rigid))]} is not a rotation; {remedy}")
