"""The files of an ONNX model: the graph, and those beside it that hold its weights."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.files import regular

EXPORT = "export it again"


def model_files(path: Path) -> list[Path]:
    """The graph's file, and every file that a tensor of it names, in the order of their first use.

    Raises: InputError naming weights that are missing or outside the graph's folder.
    """
    remedy = f"{path} keeps weights there: put the file back, or {EXPORT}"
    beside = [path.parent / name for name in weight_files(path)]
    for file in beside:
        regular(file, remedy)
    return [path, *beside]


def weight_files(path: Path) -> tuple[str, ...]:
    """File names of a graph's external weights, relative to its folder; none of what is no graph,
    as onnxruntime reports that.
    """
    return _named(path, _stamp(path)) or ()


def is_graph(path: Path) -> bool:
    """True of an ONNX file, whatever its graph."""
    return _named(path, _stamp(path)) is not None


def model_sha256(path: Path) -> str:
    """The sha256 of a model: of its file, or of the sha256s of all where weights lie beside it."""
    first, *others = (sha256_file(file) for file in model_files(path))
    return hashlib.sha256("\n".join([first, *others]).encode()).hexdigest() if others else first


def _stamp(path: Path) -> tuple[int, ...]:
    state = regular(path, EXPORT)
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


@lru_cache(maxsize=16)
def _named(path: Path, stamp: tuple[int, ...]) -> tuple[str, ...] | None:
    """`weight_files`, None of what is no graph. Cached by `stamp`, which changes with the file:
    graphs may hold gigabytes.
    """
    import onnx

    try:
        model = onnx.load(path, load_external_data=False)
    except Exception:  # protobuf's own error, of a package that we do not depend on
        return None
    if not model.ListFields():  # an empty file parses, too
        return None
    external = onnx.TensorProto.EXTERNAL
    names = [
        os.path.normpath(entry.value)
        for tensor in _tensors(model, onnx.TensorProto)
        if tensor.data_location == external
        for entry in tensor.external_data
        if entry.key == "location"
    ]
    for name in names:
        if os.path.isabs(name) or name.startswith("..") or name == "." or "\0" in name:
            raise InputError(
                f"{path} has weights outside its folder, or in no file ({name[:100]!r}); {EXPORT}"
            )
    return tuple(dict.fromkeys(name for name in names if name != path.name))


def _tensors(message: Any, kind: type) -> Iterator[Any]:
    """All tensors in a message, however deep: of the graph, of graphs within, of functions."""
    if isinstance(message, kind):
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in [value] if hasattr(value, "ListFields") else value:
                yield from _tensors(part, kind)
