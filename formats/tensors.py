"""Named arrays in one safetensors file: no pickle, every array checked for dtype and shape on reading."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest, remedy_of

Spec = tuple[Any, ...]  # of an array: its dtype, then its sizes


def write_tensors(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays. Raises ValueError on a name with a non-finite value: nothing bad is ever published."""
    for name, array in arrays.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(f"{path.name}: {name} holds {np.sum(~np.isfinite(array))} non-finite values")
    path.write_bytes(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))


def read_tensors(
    root: Path, manifest: Manifest, name: str, specs: Mapping[str, Spec] | None = None
) -> dict[str, np.ndarray]:
    """Read a listed file after comparing its digest.

    Args:
      specs: what must be there, e.g. ("float32", "n", 3); a string is a size that has to agree wherever it occurs.
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
            raise InputError(f"{path}: {key} is {arrays[key].dtype}, expected {dtype}; {remedy_of(root)}")
        fits = len(stored) == len(shape) and all(
            n == (sizes.setdefault(want, n) if isinstance(want, str) else want)
            for n, want in zip(stored, shape, strict=True)
        )
        if not fits:
            raise InputError(f"{path}: {key} has shape {stored}, expected {tuple(shape)}; {remedy_of(root)}")
    return arrays
