"""Point clouds in PLY files: positions, and colours where they are given."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import regular

LONGEST_HEADER = 1 << 16  # bytes
MOST = 20_000_000  # points; a room's scan has some hundred thousand
FARTHEST = 1e6  # scene units: beyond, float32 tells no 0.06 apart
DAMAGE = (ValueError, TypeError, LookupError, OSError, MemoryError, OverflowError)


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions f32 [N, 3] and colours u8 [N, 3], None without any. Raises InputError naming file and remedy."""
    from plyfile import PlyData, PlyParseError

    size = regular(path, "restore it: no other points take its place").st_size
    _check_header(path, size)
    try:
        vertex = PlyData.read(str(path))["vertex"]
        known = {part.name for part in vertex.properties}
        with np.errstate(over="ignore"):
            points = np.stack([np.asarray(vertex[axis], np.float32) for axis in "xyz"], 1)
    except (PlyParseError, *DAMAGE) as error:
        raise InputError(f"{path} is not a readable PLY with x, y, z ({error}); copy it again") from None
    if not len(points):
        raise InputError(f"{path} holds no point; restore it")
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


def _check_header(path: Path, size: int) -> None:
    """Raise InputError if a PLY's header counts more than the file can hold, or than is read.

    Every row has a byte at least, which is enough to keep what is allocated near what there is.
    """
    with path.open("rb") as handle:
        start = handle.read(LONGEST_HEADER)
    header, found, _ = start.partition(b"end_header")
    if not start.startswith(b"ply") or not found:
        raise InputError(f"{path} is not a readable PLY (no header of at most {LONGEST_HEADER} bytes); copy it again")
    counts = [int(count[:20]) for count in re.findall(rb"^element\s+\S+\s+(\d+)", header, re.MULTILINE)]
    if any(count > size - len(header) for count in counts):
        raise InputError(f"{path} counts {max(counts)} rows in {size} bytes; copy it again")
    if any(count > MOST for count in counts):
        raise InputError(f"{path} counts {max(counts)} rows, more than the {MOST} that are read; thin it")
    if re.search(rb"^element\s+vertex\b[^\n]*\n(?:(?!element)[^\n]*\n)*?property\s+list", header, re.MULTILINE):
        raise InputError(f"{path} has lists among a point's properties, which no point cloud has; convert it")
