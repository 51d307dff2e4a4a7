"""Chunked arrays in zarr v3, one view a file; every chunk present and checksummed, so that no fill value is read.

Measured traps this closes: a missing chunk and a zero-byte one read silently as fill values, a flipped bit reads
silently as data. Presence and size come from the manifest, the bits from each chunk's crc32c.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.artifact import Manifest


def create_array(
    path: Path,
    shape: Sequence[int],
    dtype: Any,
    dimensions: Sequence[str],
    units: str = "",
    chunks: Sequence[int] | None = None,
    shards: Sequence[int] | None = None,
    scale_factor: float | None = None,
) -> Any:
    """An empty zarr array; `chunks` defaults to one entry of the first dimension. Float arrays have nan as fill value.

    Args: shards: what one file holds, whole chunks of it in every dimension; None: a chunk a file;
      scale_factor: what a stored integer counts, by the convention of CF and xarray, kept as an attribute.
    """
    import zarr
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return zarr.create_array(
        str(path),
        shape=tuple(shape),
        dtype=dtype,
        chunks=tuple(chunks or (1, *(max(n, 1) for n in shape[1:]))),
        shards=None if shards is None else tuple(shards),
        compressors=[ZstdCodec(level=3), Crc32cCodec()],
        fill_value=float("nan") if np.dtype(dtype).kind == "f" else 0,
        dimension_names=list(dimensions),
        attributes={"units": units} | ({} if scale_factor is None else {"scale_factor": scale_factor}),
        config={"write_empty_chunks": True},
    )


def write_array(
    path: Path,
    data: np.ndarray,
    dimensions: Sequence[str],
    units: str = "",
    chunks: Sequence[int] | None = None,
    shards: Sequence[int] | None = None,
    scale_factor: float | None = None,
) -> None:
    """Write one array whole; see `create_array`. Raises OSError if a chunk is not on disk afterwards."""
    array = create_array(path, data.shape, data.dtype, dimensions, units, chunks, shards, scale_factor)
    array[:] = data
    absent = [name for name in chunk_names(array) if not (path / name).is_file()]
    if absent:
        raise OSError(f"{path / absent[0]} was not written ({len(absent)} chunks absent)")


def settle(seconds: float = 2.0) -> None:
    """Wait until no chunk is on its way to the disk: where one fails, zarr goes on with the others behind our back."""
    from zarr.core.sync import sync

    async def others() -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        if tasks:
            await asyncio.wait(tasks, timeout=seconds)

    sync(others())


def chunk_names(array: Any) -> list[str]:
    """Files that hold an array's values, below its folder."""
    grid = [range(math.ceil(n / c)) for n, c in zip(array.shape, _file_shape(array), strict=True)]
    return ["/".join(["c", *map(str, index)]) for index in itertools.product(*grid)]


def _file_shape(array: Any) -> tuple[int, ...]:
    """Entries that one file holds: a shard, or a chunk of an array without shards."""
    return array.shards or array.chunks


class StoredArray:
    """A published array, read chunk by chunk: `array[i]`, `array[a:b]`, `array[:]` give numpy arrays."""

    def __init__(self, root: Path, manifest: Manifest, name: str):
        """Raises: InputError if metadata is damaged or a chunk is not listed in the manifest."""
        import zarr

        self.root, self.path = root, root / name
        artifact.checked(root, manifest, f"{name}/zarr.json")
        try:
            self._array: Any = zarr.open_array(str(self.path), mode="r")
        except (ValueError, KeyError, OSError) as error:
            raise InputError(
                f"{self.path / 'zarr.json'} is not zarr metadata ({error}); {artifact.remedy(root)}"
            ) from None
        for chunk in chunk_names(self._array):
            if f"{name}/{chunk}" not in manifest.files:
                raise InputError(f"{self.path / chunk} is missing; {artifact.remedy(root)}")
        self.shape: tuple[int, ...] = self._array.shape
        self.dtype: np.dtype = self._array.dtype
        attributes: Any = self._array.attrs
        self.scale_factor: float = attributes.get("scale_factor", 1.0)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        try:
            return np.asarray(self._array[index])
        except IndexError:
            raise
        except (ValueError, RuntimeError, OSError) as error:
            raise InputError(f"{self.path}: {self._culprit()}: {error}; {artifact.remedy(self.root)}") from None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def _culprit(self) -> str:
        """The first chunk that does not decode, for the message."""
        sizes = _file_shape(self._array)
        for name in chunk_names(self._array):
            where = tuple(slice(int(k) * n, (int(k) + 1) * n) for k, n in zip(name.split("/")[1:], sizes, strict=True))
            try:
                self._array[where]
            except (ValueError, RuntimeError, OSError):
                return f"chunk {name} is damaged"
        return "a chunk is damaged"


def open_array(root: Path, manifest: Manifest, name: str, shape: Sequence[int | None], dtype: str) -> StoredArray:
    """A listed array whose shape (None: any size) and dtype are as expected. Raises InputError otherwise."""
    array = StoredArray(root, manifest, name)
    fits = len(array.shape) == len(shape) and all(w in (None, n) for n, w in zip(array.shape, shape, strict=True))
    if not fits or array.dtype != np.dtype(dtype):
        raise InputError(
            f"{array.path} is {array.dtype} {array.shape}, expected {dtype} {tuple(shape)}; {artifact.remedy(root)}"
        )
    return array


def has_array(manifest: Manifest, name: str) -> bool:
    return f"{name}/zarr.json" in manifest.files
