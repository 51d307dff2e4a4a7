"""Named arrays in files: our safetensors, checked for dtype and shape, and users' .npy and .npz.

Sizes that .npy and .npz declare are compared with their bytes before anything is allocated.
Measured traps: a header of 100 bytes that declares terabytes, a zip of 400 KB that unpacks to 3 GB,
  a FIFO.
"""

from __future__ import annotations

import lzma
import math
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.files import regular
from chebsplat.formats.manifest import Manifest, remedy_of

Spec = tuple[Any, ...]  # of an array: its dtype, then its sizes
LARGEST = 256 << 20  # bytes of all requested arrays, unpacked
_PARSING = threading.Lock()  # of headers: threads that parse at once fail now and then (3.11)
# raised by numpy and zipfile; RuntimeError is an unknown compression
_BROKEN = (OSError, ValueError, EOFError, RuntimeError, MemoryError, KeyError, TypeError,
           zipfile.BadZipFile, zlib.error, lzma.LZMAError, tokenize.TokenError)  # fmt: skip


def write_tensors(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays. Raises ValueError naming an array with nan or infinity."""
    for name, array in arrays.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(
                f"{path.name}: {name} holds {np.sum(~np.isfinite(array))} non-finite values"
            )
    path.write_bytes(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))


def read_tensors(
    root: Path, manifest: Manifest, name: str, specs: Mapping[str, Spec] | None = None
) -> dict[str, np.ndarray]:
    """Read a listed file after comparing its digest.

    Args:
      specs: arrays required, e.g. ("float32", "n", 3); a named size agrees wherever it occurs.
    Raises: InputError naming the file, the array and the remedy.
    """
    path = artifact.checked(root, manifest, name)
    try:
        arrays = load_file(path)
    except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(f"{path} is not a safetensors file ({error}); {remedy_of(root)}") from None
    sizes: dict[str, int] = {}
    for key, (dtype, *shape) in (specs or {}).items():
        if key not in arrays:
            raise InputError(f"{path} has no array {key}; {remedy_of(root)}")
        stored = arrays[key].shape
        if arrays[key].dtype.name != dtype:
            raise InputError(
                f"{path}: {key} is {arrays[key].dtype}, expected {dtype}; {remedy_of(root)}"
            )
        fits = len(stored) == len(shape) and all(
            n == (sizes.setdefault(size, n) if isinstance(size, str) else size)
            for n, size in zip(stored, shape, strict=True)
        )
        if not fits:
            raise InputError(
                f"{path}: {key} has shape {stored}, expected {tuple(shape)}; {remedy_of(root)}"
            )
    return arrays


def read_npy(path: Path, remedy: str, largest: int = LARGEST) -> np.ndarray:
    """The array of a .npy file. Raises InputError naming the file, what is wrong and the remedy."""
    with _readable(path, ".npy", remedy), path.open("rb") as handle:
        return _array(handle, path.stat().st_size, largest)


def read_npz(
    path: Path, names: Sequence[str], remedy: str, largest: int = LARGEST
) -> dict[str, np.ndarray]:
    """Those of the named arrays that an .npz holds; others stay packed. Raises as `read_npy`."""
    arrays: dict[str, np.ndarray] = {}
    with _readable(path, ".npz", remedy), zipfile.ZipFile(path) as archive:
        members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        for name in names:
            if name in members:
                with archive.open(members[name]) as handle:
                    arrays[name] = _array(handle, members[name].file_size, largest)
                largest -= arrays[name].nbytes
    return arrays


def finite32(values: np.ndarray) -> np.ndarray | None:
    """Numbers as f32, None where they are no numbers or not finite in f32."""
    if values.dtype.kind not in "fiu":
        return None
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return values if np.isfinite(values).all() else None


@contextmanager
def _readable(path: Path, kind: str, remedy: str) -> Iterator[None]:
    regular(path, remedy)
    try:
        yield
    except _BROKEN as error:
        line = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path} is not a readable {kind} ({line}); {remedy}") from None


def _array(handle: Any, size: int, largest: int) -> np.ndarray:
    """The array at the handle of a file (or zip member) of `size` bytes. Raises ValueError."""
    version = np.lib.format.read_magic(handle)
    read_header: Any = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    with _PARSING:
        shape, by_columns, dtype = read_header(handle)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are not read")
    declared = math.prod(shape) * dtype.itemsize
    if handle.tell() + declared != size:
        raise ValueError(
            f"it declares {declared:,} bytes and holds {max(size - handle.tell(), 0):,}"
        )
    if declared > largest:
        raise ValueError(f"it holds {declared:,} bytes, at most {largest:,} are read")
    values = np.empty(shape[::-1] if by_columns else shape, dtype)
    if declared and handle.readinto(values.reshape(-1).view(np.uint8)) != declared:
        raise ValueError("it is cut short")
    return values.T if by_columns else values
