"""The similarity between a scene's artifacts and its source's world, for single precision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from chebsplat.errors import InputError

# extents of cameras in scene units, for which near planes and thresholds are made
EXTENTS = (0.1, 1000.0)
FARTHEST = 1000.0  # extents from the origin, where float32 has steps of 6e-5 extents


@dataclass(frozen=True)
class World:
    """A source's point is origin + scale · the artifacts' point; depths scale alike."""

    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    @classmethod
    def of(cls, eyes: np.ndarray) -> Self:
        """The world for cameras at `eyes` [V, 3] in the source's; non-finite ones are ignored.

        Choices: a scene of sane size about a sane origin stays as it is. Others are brought to an
          extent of 1 to 10 units by a power of ten, and about the origin by a round number near the
          middle of the cameras, so that a scene that was moved or scaled by such a number is as
          before. One place alone has no extent: its scale stays. A few cameras gone astray decide
          nothing: middle and extent are medians.
        """
        eyes = eyes[np.isfinite(eyes).all(1)]
        if not len(eyes):
            return cls()
        middle = np.median(eyes, 0)
        extent = 2 * float(np.median(np.linalg.norm(eyes - middle, axis=1)))
        if extent <= 1e-12 * np.abs(middle).max():  # no more than rounding
            extent = 1.0
        unit = float(10.0 ** np.floor(np.log10(extent)))
        sane = EXTENTS[0] <= extent <= EXTENTS[1]
        near = np.linalg.norm(middle) <= FARTHEST * extent
        origin = 0 * middle if near else (middle / (100 * unit)).round() * (100 * unit)
        return cls(tuple(origin.tolist()), 1.0 if sane else unit)

    @classmethod
    def read(cls, notes: Mapping[str, Any]) -> Self:
        """The world in an artifact's notes; the identity where they lack it. Raises InputError."""
        world_note = notes.get("world")
        if world_note is None:
            return cls()
        try:
            world = cls(tuple(map(float, world_note["origin"])), float(world_note["scale"]))
            if not (
                np.isfinite(world.origin).all()
                and len(world.origin) == 3
                and 0 < world.scale < np.inf
            ):
                raise ValueError
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"world {str(world_note)[:80]} is no place of a scene; make the artifact again"
            ) from None
        return world

    @property
    def notes(self) -> dict[str, Any]:
        """The entry that `read` understands; empty for the identity."""
        return {} if self == HERE else {"world": {"origin": list(self.origin), "scale": self.scale}}

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] in the source's world, f64; unchanged f32 where the worlds are one."""
        return (
            points
            if not self.notes
            else np.asarray(self.origin) + self.scale * points.astype(np.float64)
        )

    def inward(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] of the source's world in the artifacts'."""
        return points if not self.notes else (points - np.asarray(self.origin)) / self.scale

    def poses_outward(self, cam_from_world: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] of cameras in the source's world."""
        poses = cam_from_world.copy()
        poses[..., :3, 3] = self.scale * poses[..., :3, 3] - poses[..., :3, :3] @ self.origin
        return poses

    def poses_inward(self, cam_from_world: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] of cameras of the source's world in the artifacts'."""
        poses = cam_from_world.copy()
        poses[..., :3, 3] = (poses[..., :3, 3] + poses[..., :3, :3] @ self.origin) / self.scale
        return poses


HERE = World()  # the identity
