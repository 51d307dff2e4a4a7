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
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Len

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.documents import Count, NotRequired, Positive, TypedDict, conform
from chebsplat.formats.files import parse_json
from chebsplat.formats.manifest import Manifest, remedy_of

TIGHTEST = 32_768  # bytes that zstd packs into one


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
    entries: tuple[int, ...] = array.shards or array.chunks
    return entries


class StoredArray:
    """A published array, read chunk by chunk: `array[i]`, `array[a:b]`, `array[:]` give numpy arrays.

    Values are held against `within` (lowest, highest) as they are read; nan lies in no range.
    """

    def __init__(self, root: Path, manifest: Manifest, name: str, within: tuple[float, float] | None = None):
        """Open the array `name` of the artifact at `root`; no value is read yet.

        Raises: InputError if metadata is damaged, or its chunks are not those that the manifest lists.
        """
        import zarr

        self.root, self.path, self.within = root, root / name, within
        metadata = artifact.checked(root, manifest, f"{name}/zarr.json")
        _check_metadata(metadata, manifest, name, remedy_of(root))
        try:
            self._array: Any = zarr.open_array(str(self.path), mode="r")
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise InputError(f"{metadata} is not zarr metadata ({error}); {remedy_of(root)}") from None
        self.shape: tuple[int, ...] = self._array.shape
        self.dtype: np.dtype = self._array.dtype
        attributes: Any = self._array.attrs
        self.scale_factor: float = attributes.get("scale_factor", 1.0)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        try:
            values = np.asarray(self._array[index])
        except IndexError:
            raise
        except (ValueError, RuntimeError, OSError) as error:
            raise InputError(f"{self.path}: {self._culprit()}: {error}; {remedy_of(self.root)}") from None
        if self.within is not None and values.size:
            low, high = self.within
            if not (values.min() >= low and values.max() <= high):
                raise InputError(
                    f"{self.path} holds {values.min():g} to {values.max():g}, {low:g} to {high:g} are possible; "
                    + remedy_of(self.root)
                )
        return values

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


def open_array(
    root: Path,
    manifest: Manifest,
    name: str,
    shape: Sequence[int | None],
    dtype: str,
    within: tuple[float, float] | None = None,
) -> StoredArray:
    """A listed array whose shape (None: any size) and dtype are as expected. Raises InputError otherwise."""
    array = StoredArray(root, manifest, name, within)
    fits = len(array.shape) == len(shape) and all(w in (None, n) for n, w in zip(array.shape, shape, strict=True))
    if not fits or array.dtype != np.dtype(dtype):
        raise InputError(
            f"{array.path} is {array.dtype} {array.shape}, expected {dtype} {tuple(shape)}; {remedy_of(root)}"
        )
    return array


class _Codec(TypedDict):
    name: Literal["bytes", "zstd", "crc32c", "sharding_indexed"]
    configuration: NotRequired[dict[str, Any]]


class _Chunks(TypedDict):
    chunk_shape: list[Annotated[int, Ge(1)]]


class _Grid(TypedDict):
    name: Literal["regular"]
    configuration: _Chunks


class _Attributes(TypedDict):
    scale_factor: NotRequired[Positive]


class _Metadata(TypedDict):
    """What `create_array` writes of zarr's own."""

    zarr_format: Literal[3]
    node_type: Literal["array"]
    shape: Annotated[list[Count], Len(1, 8)]
    data_type: Literal["bool", "uint8", "int16", "int32", "float16", "float32"]
    chunk_grid: _Grid
    codecs: list[_Codec]
    attributes: _Attributes


def _check_metadata(file: Path, manifest: Manifest, name: str, remedy: str) -> None:
    """Hold what zarr's metadata declare against the files of the manifest, before zarr believes them.

    Choices: zstd stores 128 KB of one value in 4 bytes, its best; what claims to be packed more tightly lies.
    """
    metadata = conform(parse_json(file, remedy), _Metadata, file, remedy)
    shape, part = metadata["shape"], metadata["chunk_grid"]["configuration"]["chunk_shape"]
    for codec in metadata["codecs"]:
        inner = codec.get("configuration", {})
        conform([*inner.get("codecs", []), *inner.get("index_codecs", [])], list[_Codec], file, remedy)
    sizes = {path: entry["bytes"] for path, entry in manifest.files.items() if path.startswith(f"{name}/c/")}
    if len(part) != len(shape):
        raise InputError(f"{file} declares chunks {part} of an array {shape}; {remedy}")
    grid = [-(-n // c) for n, c in zip(shape, part, strict=True)]
    for k in range(min(math.prod(grid), len(sizes) + 1)):
        if (chunk := "/".join([name, "c", *map(str, _unravelled(k, grid))])) not in sizes:
            raise InputError(f"{file.parents[name.count('/') + 1] / chunk} is missing; {remedy}")
    size, least = math.prod(part) * np.dtype(metadata["data_type"]).itemsize, min(sizes.values(), default=0)
    if sizes and size > TIGHTEST * max(least, 64):
        raise InputError(f"{file} declares {size:,} bytes of a file of {least}; {remedy}")


def _unravelled(k: int, grid: list[int]) -> list[int]:
    """Indices of the k-th file in a grid of any size."""
    index = []
    for n in reversed(grid):
        k, last = divmod(k, n)
        index.append(last)
    return index[::-1]


def has_array(manifest: Manifest, name: str) -> bool:
    """Whether an artifact lists an array of that name."""
    return f"{name}/zarr.json" in manifest.files
