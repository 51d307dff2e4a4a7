"""The vertices of a PLY file: the one door to reading PLY. What its header declares is held against the file's size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from plyfile import PlyData, PlyListProperty, PlyParseError

from chebsplat.errors import InputError
from chebsplat.formats.files import regular

HEADER = 1 << 20  # bytes that a header may take
_PART = re.compile(rb"^[ \t]*(?:element[ \t]+\S+[ \t]+(\d{1,30})|(property))\b", re.MULTILINE)


def read_vertices(path: Path, remedy: str) -> Any:
    """plyfile's element `vertex`, of scalar properties. Raises InputError naming the file and the remedy.

    Choices: a value takes a byte at least, in text and in binary; a header that declares more values than the file has
      bytes lies, and is refused before anything is allocated.
    """
    size = regular(path, remedy).st_size
    try:
        with path.open("rb") as handle:
            header, end, _ = handle.read(HEADER).partition(b"end_header")
        if not header.startswith(b"ply") or not end:
            raise ValueError("it has no PLY header")
        if (declared := _values(header)) > size:
            raise ValueError(f"it declares {declared:,} values and has {size:,} bytes")
        vertex = PlyData.read(str(path))["vertex"]
    except (PlyParseError, OSError, LookupError, TypeError, ValueError, MemoryError, OverflowError) as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is not a readable PLY ({line}); {remedy}") from None
    lists = [part.name for part in vertex.properties if isinstance(part, PlyListProperty)]
    if lists:
        raise InputError(f"{path}: {lists[0][:60]} holds lists, one number a vertex is needed; {remedy}")
    return vertex


def _values(header: bytes) -> int:
    """Values that a header declares, a list counted as one."""
    total = count = 0
    for number, is_property in _PART.findall(header):
        if is_property:
            total += count
        else:
            count = int(number)
    return total
