"""Artifacts of numbers: a dataclass stored as one zarr v3 group of arrays and attributes.

`zarr.open_group(path)["means"][:]` reads any of them. Integrity is checked in three ways: the
manifest has every file with its size, `zarr.json` files are compared with their digest, and each
chunk carries its crc32c.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, Self, get_args, get_type_hints

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.files import parse_json
from chebsplat.formats.manifest import Manifest, remedy_of

BATCH = 2**25  # bytes compressed at a time
ROWS = 65_536  # entries of the first axis in a chunk, where an array isn't read view by view
METADATA = "zarr.json"


@dataclass(frozen=True)
class Array:
    """Storage of a field of a `Record`.

    Args:
      axes:     names, or lengths where fixed; a name has one length throughout a record.
      by_view:  one entry of the first axis a chunk; the array stays on disk until it is indexed.
      any_value: nan and infinities may be stored.
    """

    dtype: str
    axes: tuple[str | int, ...]
    units: str = ""
    by_view: bool = False
    any_value: bool = False


class Record:
    """Base of a dataclass that is stored as one zarr group.

    A field annotated with an `Array` is an array of the group, absent where it is None; a field
    that is a `Record` is a group within; any other field is an attribute and must be JSON-able.
    """

    SCHEMA: ClassVar[str] = ""
    COMPRESSED: ClassVar[bool] = True

    def write(self, out: Path) -> None:
        """Fill the directory of `artifact.publish`; an array that lies in `out` already stays.

        Raises: ValueError naming an array of another dtype or shape, or a value that is not finite.
        """
        stored = dict(_arrays_of(self))
        values = {name: _convert(name, value, spec) for name, (spec, value) in stored.items()}
        check_lengths({name: (spec.axes, values[name].shape) for name, (spec, _) in stored.items()})
        self.write_attributes(out)
        for name, (spec, _) in stored.items():
            if isinstance(values[name], np.ndarray):
                write_array(out / name, values[name], spec, self.COMPRESSED)

    def write_attributes(self, out: Path) -> None:
        """Write the group's own metadata, anew where they are there already.

        Raises: ValueError or TypeError on a value that JSON or UTF-8 does not have, nan among them.
        """
        specs = {name: spec for name, (spec, _) in _arrays_of(self)}
        attributes = {
            "schema": self.SCHEMA,
            "axes": {name: list(spec.axes) for name, spec in specs.items()},
            "units": {name: spec.units for name, spec in specs.items() if spec.units},
        } | _attributes_of(self)
        json.dumps(attributes, allow_nan=False, ensure_ascii=False).encode()
        files: dict[str, Any] = {}
        zarr.create_group(MemoryStore(files), attributes=attributes)
        for name in {place.rpartition("/")[0] for place in specs} - {""}:
            zarr.create_group(MemoryStore(files), path=name)
        _put(files, out)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The record at `path`. Raises InputError naming the damaged file and the remedy."""
        path = Path(path)
        manifest = artifact.read_manifest(path, cls.SCHEMA)
        with reading(path):
            attributes = read_attributes(path, manifest)
            for name in ("schema", "axes", "units"):
                del attributes[name]
            record: Self = _built(cls, path, manifest, attributes)
            stored = dict(_arrays_of(record))
            check_lengths(
                {name: (spec.axes, value.shape) for name, (spec, value) in stored.items()}
            )
        return record


def read_attributes(path: Path, manifest: Manifest) -> dict[str, Any]:
    """Attributes of an artifact's group; no array is opened. Raises InputError naming the file."""
    document = parse_json(artifact.checked(path, manifest, METADATA), remedy_of(path))
    attributes: dict[str, Any] = document["attributes"]
    return attributes


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors within, of a damaged artifact at `path`, into an InputError with the remedy."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OSError) as error:
        line = " ".join(str(error).split())[:300]
        raise InputError(f"{path} cannot be read ({line}); {remedy_of(path)}") from None


class StoredArray:
    """An array of a published artifact; `array[i]` and `array[:]` read numpy arrays from disk."""

    def __init__(self, root: Path, manifest: Manifest, name: str):
        """Open the array `name` of the artifact at `root`; no value is read yet.

        Raises: InputError if its metadata are damaged, or the manifest does not list all of its
          chunks: zarr would read those as fill values.
        """
        self.root, self.name, self.manifest = root, name, manifest
        artifact.checked(root, manifest, f"{name}/{METADATA}")
        with reading(root):
            self._array: Any = zarr.open_array(str(root / name), mode="r")
        self.shape: tuple[int, ...] = self._array.shape
        self.dtype: np.dtype = self._array.dtype
        for chunk in chunk_names(self._array):
            if f"{name}/{chunk}" not in manifest.files:
                raise InputError(f"{root / name / chunk} is missing; {remedy_of(root)}")

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        try:
            return np.asarray(self._array[index])
        except (ValueError, RuntimeError, OSError) as error:
            for chunk in chunk_names(self._array):
                artifact.checked(self.root, self.manifest, f"{self.name}/{chunk}")
            raise InputError(f"{self.root / self.name}: {error}; {remedy_of(self.root)}") from None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)


Stack = np.ndarray | StoredArray


def create_array(
    store: Path | zarr.storage.MemoryStore,
    shape: tuple[int, ...],
    spec: Array,
    compressed: bool = True,
) -> zarr.Array[Any]:
    """An array to be filled chunk by chunk. store: its folder, in that of its group, or memory."""
    rows = 1 if spec.by_view else ROWS
    return zarr.create_array(
        store,
        shape=shape,
        dtype=spec.dtype,
        chunks=tuple(max(min(n, rows) if axis == 0 else n, 1) for axis, n in enumerate(shape)),
        compressors=[*([ZstdCodec(level=3)] if compressed else []), Crc32cCodec()],
        fill_value=float("nan") if np.dtype(spec.dtype).kind == "f" else 0,
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=[axis if isinstance(axis, str) else None for axis in spec.axes],
        attributes={"units": spec.units} if spec.units else None,
        config={"write_empty_chunks": True},
    )


def write_array(path: Path, values: np.ndarray, spec: Array, compressed: bool = True) -> None:
    """Write an array whole.

    Choices: chunks are compressed side by side in memory, so many at a time as BATCH bytes hold,
      and written one by one: twice as fast as zarr's own files, and where a disk is full no other
      write is under way.
    """
    files: dict[str, Any] = {}
    array = create_array(MemoryStore(files), values.shape, spec, compressed)
    rows = array.chunks[0] * max(1, BATCH // max(math.prod(array.chunks) * array.dtype.itemsize, 1))
    for start in range(0, max(len(values), 1), rows):
        if values.size:
            array[start : start + rows] = values[start : start + rows]
        _put(files, path)
        files.clear()


def _put(files: dict[str, Any], folder: Path) -> None:
    """Write the files of a memory store into a folder."""
    for name, buffer in files.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(buffer.to_bytes())


def chunk_names(array: zarr.Array[Any]) -> Iterator[str]:
    """Files that hold an array's values, below its folder."""
    counts = (
        range(math.ceil(n / chunk)) for n, chunk in zip(array.shape, array.chunks, strict=True)
    )
    return (".".join(["c", *map(str, place)]) for place in itertools.product(*counts))


def check_lengths(arrays: dict[str, tuple[tuple[str | int, ...], tuple[int, ...]]]) -> None:
    """Compare shapes with axes. Raises ValueError naming the first array that differs.

    Args: arrays: by name its axes and its shape.
    """
    lengths: dict[str | int, int] = {}
    for name, (axes, shape) in arrays.items():
        for axis, n in zip(axes, shape, strict=False):
            if isinstance(axis, str):
                lengths.setdefault(axis, n)
        expected = tuple(
            lengths.get(axis, axis) if isinstance(axis, str) else axis for axis in axes
        )
        if shape != expected:
            raise ValueError(f"{name} has shape {shape}, expected {expected}")


@dataclass(frozen=True)
class Layout:
    """Fields of a record: arrays by name, optional arrays, records within, names of attributes."""

    arrays: dict[str, Array]
    optional: set[str]
    records: dict[str, type[Record]]
    attributes: list[str]


@cache
def layout_of(cls: type[Record]) -> Layout:
    """Sort the fields of a record by how they are stored."""
    layout = Layout({}, set(), {}, [])
    hints = get_type_hints(cls, include_extras=True)
    for name in (field.name for field in fields(cls)):  # type: ignore[arg-type]  # a dataclass
        parts = (hints[name], *get_args(hints[name]))
        spec = next((part for part in parts if isinstance(part, Array)), None)
        within = next(
            (part for part in parts if isinstance(part, type) and issubclass(part, Record)), None
        )
        if spec is not None:
            layout.arrays[name] = spec
            if NoneType in get_args(parts[1]):
                layout.optional.add(name)
        elif within is not None:
            layout.records[name] = within
        else:
            layout.attributes.append(name)
    return layout


def _arrays_of(record: Record, prefix: str = "") -> Iterator[tuple[str, tuple[Array, Any]]]:
    """Name, specification and value of each array of a record and of the records within."""
    layout = layout_of(type(record))  # type: ignore[arg-type]  # mypy takes no class for hashable
    for name, spec in layout.arrays.items():
        if (value := getattr(record, name)) is not None:
            yield prefix + name, (spec, value)
    for name in layout.records:
        if (within := getattr(record, name)) is not None:
            yield from _arrays_of(within, f"{prefix}{name}/")


def _attributes_of(record: Record) -> dict[str, Any]:
    layout = layout_of(type(record))  # type: ignore[arg-type]  # mypy takes no class for hashable
    attributes = {name: getattr(record, name) for name in layout.attributes}
    within = {name: getattr(record, name) for name in layout.records}
    return attributes | {
        name: None if value is None else _attributes_of(value) for name, value in within.items()
    }


def _built(
    cls: type[Any], path: Path, manifest: Manifest, attributes: dict[str, Any], prefix: str = ""
) -> Any:
    """A record of the arrays that the manifest lists below `prefix`, and of its attributes."""
    layout, values = layout_of(cls), dict(attributes)  # type: ignore[arg-type]
    for name, within in layout.records.items():
        if values[name] is not None:
            artifact.checked(path, manifest, f"{prefix}{name}/{METADATA}")
            values[name] = _built(within, path, manifest, values[name], f"{prefix}{name}/")
    for name, spec in layout.arrays.items():
        if f"{prefix}{name}/{METADATA}" in manifest.files:
            array = StoredArray(path, manifest, prefix + name)
            if array.dtype != np.dtype(spec.dtype):
                raise ValueError(f"{prefix}{name} is {array.dtype}, expected {spec.dtype}")
            values[name] = array if spec.by_view else array[:]
        elif name in layout.optional:
            values[name] = None
        else:
            raise ValueError(f"there is no array {prefix}{name}")
    return cls(**values)


def _convert(name: str, value: Any, spec: Array) -> Any:
    """A value in its stored dtype; a zarr array is in its place already and returned unchanged."""
    if not isinstance(value, np.ndarray | StoredArray):
        return value
    values = np.asarray(value)
    if values.dtype != spec.dtype and not np.can_cast(values.dtype, spec.dtype, "same_kind"):
        raise ValueError(f"{name} is {values.dtype}, expected {spec.dtype}")
    with np.errstate(over="ignore"):  # infinities are refused below
        converted = values.astype(spec.dtype, copy=False)
    if (
        converted is not values
        and converted.dtype.kind in "iu"
        and not np.array_equal(converted, values)
    ):
        raise ValueError(f"{name} holds values that {spec.dtype} does not have")
    if converted.dtype.kind == "f" and not spec.any_value and not np.isfinite(converted).all():
        raise ValueError(f"{name} holds {np.sum(~np.isfinite(converted))} non-finite values")
    return converted
