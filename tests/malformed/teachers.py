"""Teachers that no scene could learn from: their TOML, their table of names, the model itself, labels to ask for."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from malformed.case import Asked, Case

TOML: dict[str, list[Any]] = {  # key of tiny.toml: values as TOML writes them
    "name": ['""', "5", '"a\\nb"'],
    "output": ['"classes"', "5"],
    "mean": ["[0.5]", "0.5", "[nan, 0.5, 0.5]", "[inf, 0.5, 0.5]", "[1e300, 0.5, 0.5]", '["a", "b", "c"]'],
    "std": ["[0, 0.5, 0.5]", "[-1.0, 0.5, 0.5]", "[1e-300, 0.5, 0.5]", "[nan, 0.5, 0.5]"],
    "size": ["[32]", "[0, 32]", "[-32, 32]", "[1000000, 1000000]", "[32.0, 32.0]", "32", "[30, 32]"],
    "multiple": ["0", "-4", "1000000000000", "4.0", "true"],
    "base": ["0", "-5", "1000000000000", "1e9"],
    "labels": ['""', "5", '"nosuch.npz"', '".."', '"a\\u0000b"'],
    "text": ["5", '"nosuch.onnx"', '"tiny.onnx"'],
    "prompt": ['"{x}"', '"{0.x}"', '"a photo"', '"{} and {}"', "5", '"{}\\u0000"'],
    "labls": ['"tiny.npz"'],
}
DOCUMENTS = {
    "binary": b"\x93NUMPY\xff\xfe",
    "deep": b"a = " + b"[" * 50_000,
    "cut": b"mean = [0.5",
    "a table": b"[mean]\na = 1\n",
    "a key twice": b"base = 5\nbase = 6\n",
}
LABELS = {
    "empty": b"",
    "comments": b"# a\n# b\n",
    "a name twice": b"red\nred\n",
    "no name": b": crimson\n",
    "binary": b"\xff\xfe\x00r",
    "a null byte": b"re\0d\n",
    "a long name": b"r" * 5000 + b"\n",
    "a line of megabytes": b"r" * (2 << 20),
    "half a character": b"\xed\xa0\x80\n",
}


def _teacher(folder: Path, **toml: Any) -> Path:
    from tiny_teachers import color_teacher

    model = color_teacher(folder)
    lines = dict(line.split(" = ", 1) for line in (folder / "tiny.toml").read_text().splitlines())
    (folder / "tiny.toml").write_text("".join(f"{key} = {value}\n" for key, value in (lines | toml).items()))
    return model


def _ask(folder: Path, named: str, *more: str | Path) -> Asked:
    """Ask for a picture of a room's size; no room is generated for a teacher that cannot be used."""
    from PIL import Image

    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(folder / "photo.png")
    return Asked(["check-teacher", folder / "tiny.onnx", "--photo", folder / "photo.png", *more], named)


def _npy(array: np.ndarray, **header: Any) -> bytes:
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        held, {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape} | header
    )
    return held.getvalue() + array.tobytes()


NAMES, ROWS = np.array(["red", "green", "blue"]), np.eye(3, dtype=np.float32)
TABLES: dict[str, dict[str, bytes]] = {  # members of tiny.npz
    "no names": {"embeddings": _npy(ROWS)},
    "one name": {"names": _npy(np.array("red")), "embeddings": _npy(ROWS)},
    "names twice": {"names": _npy(np.array(["red", "red", "blue"])), "embeddings": _npy(ROWS)},
    "names are numbers": {"names": _npy(np.arange(3)), "embeddings": _npy(ROWS)},
    "names are objects": {"names": _npy(np.zeros(3), descr="|O"), "embeddings": _npy(ROWS)},
    "a null byte": {"names": _npy(np.array(["r\0d", "green", "blue"])), "embeddings": _npy(ROWS)},
    "a 0-d table": {"names": _npy(NAMES), "embeddings": _npy(np.float32(1).reshape(()))},
    "a row too few": {"names": _npy(NAMES), "embeddings": _npy(ROWS[:2])},
    "other channels": {"names": _npy(NAMES), "embeddings": _npy(np.eye(3, 7, dtype=np.float32))},
    "no channels": {"names": _npy(NAMES), "embeddings": _npy(ROWS[:, :0])},
    "nan": {"names": _npy(NAMES), "embeddings": _npy(ROWS * np.float32(np.nan))},
    "beyond float32": {"names": _npy(NAMES), "embeddings": _npy(np.full((3, 3), 1e300))},
    "complex": {"names": _npy(NAMES), "embeddings": _npy(ROWS.astype(np.complex64))},
    "terabytes": {"names": _npy(NAMES), "embeddings": _npy(ROWS, shape=(10**7, 10**6))},
    "a negative shape": {"names": _npy(NAMES), "embeddings": _npy(ROWS, shape=(-3, 3))},
    "no array": {"names": b"red"},
}


def _write_table(folder: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(folder / "tiny.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)


def _bomb(folder: Path) -> None:
    """20,000 x 20,000 zeros, packed to 1.6 MB without ever being whole in memory."""
    with zipfile.ZipFile(folder / "tiny.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("names.npy", _npy(NAMES))
        with archive.open("embeddings.npy", "w", force_zip64=True) as handle:
            handle.write(_npy(np.zeros(0, np.float32), shape=(20_000, 20_000)))
            for _ in range(200):
                handle.write(bytes(8_000_000))


def _model(folder: Path, nodes: list[Any], outputs: tuple[str, ...] = ("features",), **more: Any) -> None:
    from tiny_teachers import write_model

    write_model(folder / "tiny.onnx", nodes, outputs, **more)


def _endless(folder: Path) -> None:
    """A loop of 2^62 steps over the image."""
    from onnx import TensorProto, helper

    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["on"], ["more"]), helper.make_node("Neg", ["x"], ["y"])],
        "body",
        [value("k", TensorProto.INT64, []), value("on", TensorProto.BOOL, []), value("x", TensorProto.FLOAT, None)],
        [value("more", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, None)],
    )
    node = helper.make_node("Loop", ["count", "true", "image"], ["features"], body=body)
    _model(folder, [node], constants={"count": np.array(2**62), "true": np.array(True)})


def _node(op: str, **attributes: Any) -> Callable[[Path], None]:
    from onnx import helper

    return lambda folder: _model(folder, [helper.make_node(op, ["image"], ["features"], **attributes)])


def _without(part: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        import onnx

        model = onnx.load(folder / "tiny.onnx")
        del getattr(model.graph, part)[:]
        (folder / "tiny.onnx").write_bytes(model.SerializeToString())

    return write


def _huge(folder: Path) -> None:
    from onnx import helper

    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("Add", ["image", "zeros"], ["features"]),
    ]
    _model(folder, nodes, constants={"shape": np.array([1, 3, 100_000, 100_000])})


def _outside(folder: Path) -> None:
    """Weights in a file that lies above the model's folder."""
    import onnx
    from onnx.external_data_helper import set_external_data

    model = onnx.load(folder / "tiny.onnx")
    (folder.parent / "secret.bin").write_bytes(bytes(4096))
    for tensor in model.graph.initializer:
        set_external_data(tensor, "../secret.bin", 0, len(tensor.raw_data))
        tensor.ClearField("raw_data")
    (folder / "tiny.onnx").write_bytes(model.SerializeToString())


MODELS: dict[str, Callable[[Path], Any]] = {
    "no ONNX": lambda folder: (folder / "tiny.onnx").write_text("no model"),
    "empty": lambda folder: (folder / "tiny.onnx").write_bytes(b""),
    "cut": lambda folder: os.truncate(folder / "tiny.onnx", 60),
    "no inputs": _without("input"),
    "no outputs": _without("output"),
    "no nodes": _without("node"),
    "a loop of 2^62 steps": _endless,
    "an output of 120 GB": _huge,
    "weights outside": _outside,
    "one feature a view": _node("GlobalAveragePool"),
    "nan": _node("Log"),
    "flat": _node("Flatten"),
    "a shape": _node("Shape"),
    "a folder": lambda folder: ((folder / "tiny.onnx").unlink(), (folder / "tiny.onnx").mkdir()),
    "missing": lambda folder: (folder / "tiny.onnx").unlink(),
    "a pipe": lambda folder: ((folder / "tiny.onnx").unlink(), os.mkfifo(folder / "tiny.onnx")),
}


def _case(kind: str, name: str, prepare: Callable[[Path], Any], named: str, more: tuple[str, ...] = ()) -> Case:
    def build(folder: Path) -> Asked:
        inner = folder / "teacher"
        inner.mkdir()
        _teacher(inner)
        prepare(inner)
        return _ask(inner, named, *(str(inner / part) if part.endswith(".txt") else part for part in more))

    return Case(kind, name, build, (3, 4))


def cases() -> Iterator[Case]:
    for key, values in TOML.items():
        for value in values:
            yield _case("teacher.toml", f"{key} = {value}", lambda f, k=key, v=value: _teacher(f, **{k: v}), "tiny.")
    for name, content in DOCUMENTS.items():
        yield _case("teacher.toml", name, lambda f, c=content: (f / "tiny.toml").write_bytes(c), "tiny.toml")
    for name, members in TABLES.items():
        yield _case("teacher's table", name, lambda f, m=members: _write_table(f, m), "tiny.npz")
    yield _case("teacher's table", "a zip bomb", _bomb, "tiny.npz")
    yield _case("teacher's table", "no zip", lambda f: (f / "tiny.npz").write_text("no zip"), "tiny.npz")
    yield _case("teacher's table", "a pipe", lambda f: ((f / "tiny.npz").unlink(), os.mkfifo(f / "tiny.npz")), "tiny.")
    for name, damage in MODELS.items():
        yield _case("teacher's model", name, damage, "tiny.onnx")
    for name, content in LABELS.items():
        said = "labels.txt"
        yield _case("labels", name, lambda f, c=content: (f / "labels.txt").write_bytes(c), said, ("--labels", said))
