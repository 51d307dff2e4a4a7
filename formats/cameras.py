"""Cameras that travel with a scene: a reader can render it without the capture it came from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.record import Array, Record

RIGID = 1e-3  # largest entry of |RRᵀ − I|


@dataclass
class Cameras(Record):
    """names of V views; Ks f64 [V, 3, 3] pixels, cam_from_world [V, 4, 4]; size of the images;
    exposures f64 [V, 3]: stops by channel that a photo from there is expected to have more than a
    picture of the scene; None: none.
    """

    names: list[str]
    Ks: Annotated[np.ndarray, Array("float64", ("view", 3, 3), "pixels")]
    cam_from_world: Annotated[np.ndarray, Array("float64", ("view", 4, 4), "scene units")]
    width: int
    height: int
    exposures: Annotated[np.ndarray | None, Array("float64", ("view", 3), "stops")] = None

    def stops(self, index: int) -> np.ndarray | None:
        """Exposure [3] that a photo from a view is expected to have; None: the scene's."""
        return None if self.exposures is None else self.exposures[index]


def check_cameras(
    names: list[str], Ks: np.ndarray, poses: np.ndarray | None, where: object, remedy: str
) -> None:
    """Raise InputError naming the first view whose camera is unusable; poses [V, 4, 4], or None."""
    for what, data in (("Ks", Ks), ("poses", poses)):
        if data is not None and len(data) != len(names):
            raise InputError(f"{where}: {len(data)} {what} for {len(names)} views; {remedy}")
    usable = (
        np.isfinite(Ks).all((1, 2))
        & (Ks[:, 0, 0] > 0)
        & (Ks[:, 1, 1] > 0)
        & (Ks[:, 2] == [0, 0, 1]).all(1)
    )
    if not usable.all():
        raise InputError(
            f"{where}: the intrinsics of {names[int(np.argmin(usable))]} are not a "
            f"camera's; {remedy}"
        )
    if poses is None:
        return
    rotations = np.nan_to_num(poses[:, :3, :3], nan=np.inf).clip(-2, 2)
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
    rigid = (off < RIGID) & (np.linalg.det(rotations) > 0) & np.isfinite(poses).all((1, 2))
    rigid &= (poses[:, 3] == [0, 0, 0, 1]).all(1)
    if not rigid.all():
        raise InputError(
            f"{where}: the pose of {names[int(np.argmin(rigid))]} is not a rotation; {remedy}"
        )
