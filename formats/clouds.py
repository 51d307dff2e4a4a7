"""Point clouds in PLY files: positions, and colours where they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import InputError


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions f32 [N, 3] and colours u8 [N, 3], None without any. Raises InputError naming file and remedy."""
    from plyfile import PlyData, PlyParseError

    if not path.is_file():
        raise InputError(f"{path} is missing; restore it: no other points take its place")
    try:
        vertex = PlyData.read(str(path))["vertex"]
        known = {part.name for part in vertex.properties}
        points = np.stack([np.asarray(vertex[axis], np.float32) for axis in "xyz"], 1)
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError, MemoryError) as error:
        raise InputError(f"{path} is not a readable PLY with x, y, z ({error}); copy it again") from None
    if bad := int((~np.isfinite(points).all(1)).sum()):
        raise InputError(f"{path} holds {bad} points that are not finite; restore it")
    channels = ("red", "green", "blue")
    if not known.issuperset(channels):
        return points, None
    colors = np.stack([np.asarray(vertex[channel]) for channel in channels], 1)
    if colors.dtype != np.uint8:
        raise InputError(f"{path} has colours of type {colors.dtype}, not 8 bits; convert them")
    return points, colors
