"""Point clouds in PLY files: positions, and colours where they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.vertices import read_vertices

MOST = 20_000_000  # points; a room's scan has some hundred thousand
FARTHEST = 1e6  # scene units: beyond, float32 tells no 0.06 apart


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions f32 [N, 3] and colours u8 [N, 3], None without any. Raises InputError naming file and remedy."""
    vertex = read_vertices(path, "restore it: no other points take its place")
    known = {part.name for part in vertex.properties}
    if not known.issuperset("xyz"):
        raise InputError(f"{path} has no x, y, z; restore it: no other points take its place")
    if not 0 < len(vertex.data) <= MOST:
        raise InputError(f"{path} holds {len(vertex.data)} points; 1 to {MOST} are possible: restore it, or thin it")
    with np.errstate(over="ignore"):  # of doubles
        points = np.stack([np.asarray(vertex[axis], np.float32) for axis in "xyz"], 1)
    if bad := int((~(np.abs(points) <= FARTHEST).all(1)).sum()):
        raise InputError(
            f"{path} holds {bad} points that are not finite, or farther than {FARTHEST:.0e} units from the origin; "
            "restore it, or move the scene's origin into the scene"
        )
    channels = ("red", "green", "blue")
    if not known.issuperset(channels):
        return points, None
    colors = np.stack([np.asarray(vertex[channel]) for channel in channels], 1)
    if colors.dtype != np.uint8:
        raise InputError(f"{path} has colours of type {colors.dtype}, not 8 bits; convert them")
    return points, colors
