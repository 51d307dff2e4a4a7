"""Teachers that no scene could learn from: their TOML, their table of names, the model itself,
labels to ask for.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper
from onnx.external_data_helper import set_external_data
from tiny_teachers import COLORS, color_teacher, write_model, write_table

from malformed.artifacts import artifacts
from malformed.edits import DEEP, Edit, all_of, no_file, npy, npz, picture, put, remove
from malformed.row import Arguments, Row, stage

MODEL, TOML, TABLE = "tiny.onnx", "tiny.toml", "tiny.npz"
# a key of tiny.toml, its value as TOML, a word of the message
VALUES: list[tuple[str, str, str]] = [
    ("name", '""', "name"),
    ("mean", "[nan, 0.5, 0.5]", "three numbers"),
    ("std", "[0, 0.5, 0.5]", "std"),
    ("mean", "[123.675, 116.28, 103.53]", "write mean = [0.485, 0.456, 0.406]"),
    ("std", "[58.395, 57.12, 57.375]", "write std = [0.229, 0.224, 0.225]"),
    ("order", '"rgb"', "order"),
    ("resample", '"linear"', "bilinear"),
    ("size", "[1000000, 1000000]", "size"),
    ("size", "[30, 32]", "not a multiple of 4"),
    ("multiple", "0", "multiple"),
    ("base", "-5", "base"),
    ("labels", '".."', "labels"),
    ("labels", '"a\\u0000b"', "labels"),
    ("text", '"tiny.npz"', "`text` without `tokenizer`"),
    ("prompt", '"a photo"', "photo of a {}"),
    ("labls", '"tiny.npz"', "did you mean labels"),
]
NAMES, ROWS = npy(np.array(list(COLORS))), np.eye(3, dtype=np.float32)
TABLES: list[tuple[str, bytes, str]] = [
    ("no zip", b"no zip", "not a readable .npz"),
    ("no names", npz(embeddings=npy(ROWS)), "names"),
    (
        "a name twice",
        npz(names=npy(np.array(["red", "red", "blue"])), embeddings=npy(ROWS)),
        "twice",
    ),
    (
        "objects for names",
        npz(names=npy(np.zeros(3), descr="|O"), embeddings=npy(ROWS)),
        "pickled objects",
    ),
    (
        "a null byte",
        npz(names=npy(np.array(["r\0d", "green", "blue"])), embeddings=npy(ROWS)),
        "names",
    ),
    ("a row too few", npz(names=NAMES, embeddings=npy(ROWS[:2])), "embeddings"),
    (
        "other channels",
        npz(names=NAMES, embeddings=npy(np.eye(3, 5))),
        "gives 3 channels, its text embeddings have 5",
    ),
    ("nan", npz(names=NAMES, embeddings=npy(ROWS * np.float32(np.nan))), "embeddings"),
]
LABELS: list[tuple[str, bytes, str]] = [
    ("nothing", b"", "holds 0 labels"),
    ("a name twice", b"red\nred\n", "line 2: a name is given twice"),
    ("no name", b": crimson\n", "line 1: a name is missing"),
    ("binary", b"\xff\xfe\x00r", "no UTF-8 text"),
    ("a null byte", b"re\0d\n", "line 1"),
]


def set_to(key: str, value: str) -> Edit:
    def edit(folder: Path) -> None:
        lines = dict(line.split(" = ", 1) for line in (folder / TOML).read_text().splitlines())
        text = "".join(
            f"{name} = {said}\n" for name, said in (lines | {key: value}).items() if said
        )
        (folder / TOML).write_text(text)

    return edit


def model(*nodes: Any, **more: Any) -> Edit:
    return lambda folder: write_model(folder / MODEL, list(nodes), **more)


def node(op: str, *inputs: str, **attributes: Any) -> Any:
    return helper.make_node(op, list(inputs or ("image",)), ["features"], **attributes)


def endless() -> Edit:
    """A loop of 2^62 steps over the image."""
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["on"], ["more"]), helper.make_node("Neg", ["x"], ["y"])],
        "body",
        [
            value("k", TensorProto.INT64, []),
            value("on", TensorProto.BOOL, []),
            value("x", TensorProto.FLOAT, None),
        ],
        [value("more", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, None)],
    )
    constants = {"count": np.array(2**62), "true": np.array(True)}
    return model(node("Loop", "count", "true", "image", body=body), constants=constants)


def huge() -> Edit:
    """An output of 120 GB."""
    zeros = helper.make_node("ConstantOfShape", ["shape"], ["zeros"])
    return model(
        zeros,
        node("Add", "image", "zeros"),
        constants={"shape": np.array([1, 3, 100_000, 100_000])},
    )


def grown(factor: int) -> Edit:
    """An output whose sides are `factor` times the image's, by a shape that is computed when it
    runs.
    """
    nodes = [
        helper.make_node("Shape", ["image"], ["shape"]),
        helper.make_node("Mul", ["shape", "factor"], ["larger"]),
        helper.make_node("ConstantOfShape", ["larger"], ["zeros"]),
        helper.make_node("ReduceMax", ["image"], ["most"]),
    ]
    return model(
        *nodes, node("Add", "zeros", "most"), constants={"factor": np.array([1, 1, factor, factor])}
    )


def folded() -> Edit:
    """Twelve constants of 300 MB, each of which would be computed when the model is opened."""
    count, nodes = 12, [helper.make_node("ReduceMax", ["image"], ["most"])]
    for k in range(count):
        value = helper.make_tensor("value", TensorProto.FLOAT, [1], [k])
        nodes.append(helper.make_node("ConstantOfShape", ["shape"], [f"zeros{k}"], value=value))
        nodes.append(helper.make_node("Add", [f"zeros{k}", "most"], [f"sum{k}"]))
        nodes.append(helper.make_node("ReduceMean", [f"sum{k}"], [f"mean{k}"]))
    last = node("Sum", *(f"mean{k}" for k in range(count)))
    return model(*nodes, last, constants={"shape": np.array([1, 3, 5000, 5000])})


def halves() -> Edit:
    """Two halves that must be alike: a side that is no multiple of 2 fails inside the model."""
    split = helper.make_node("Split", ["image"], ["a", "b"], axis=3, num_outputs=2)
    return all_of(set_to("multiple", "13"), model(split, node("Add", "a", "b")))


def changed(change: Callable[[Any], Any]) -> Edit:
    """The model after `change`."""

    def edit(folder: Path) -> None:
        held = onnx.load(folder / MODEL)
        change(held)
        (folder / MODEL).write_bytes(held.SerializeToString())

    return edit


def two_inputs(held: Any) -> None:
    held.graph.input.append(helper.make_tensor_value_info("text", TensorProto.FLOAT, (1, 3)))


def outside(held: Any) -> None:
    """Weights in a file that lies above the model's folder."""
    for tensor in held.graph.initializer:
        set_external_data(tensor, "../secret.bin", 0, len(tensor.raw_data))
        tensor.ClearField("raw_data")


def bomb(folder: Path) -> None:
    """9,000 x 8,000 zeros, packed to 300 kB without ever being whole in memory."""
    with zipfile.ZipFile(folder / TABLE, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("names.npy", NAMES)
        with archive.open("embeddings.npy", "w", force_zip64=True) as handle:
            handle.write(npy(np.zeros(0, np.float32), shape=(9_000, 8_000)))
            for _ in range(36):
                handle.write(bytes(8_000_000))


def segmenter(names: str) -> Edit:
    """A closed set of three classes whose file gives these names."""
    of_three = partial(color_teacher, weights=5 * np.eye(3), output="logits", labels="classes.txt")
    return all_of(put("classes.txt", names), of_three)


def models() -> Iterator[tuple[str, str, Edit, str]]:
    """The file that is named, what is wrong, the edit, a word of the message."""
    relu = {"shape": (3, "H", "W")}
    yield MODEL, "no ONNX", put(MODEL, "no model"), "is not a usable ONNX model"
    yield (
        MODEL,
        "cut short",
        lambda folder: os.truncate(folder / MODEL, 60),
        ("is not a usable ONNX model"),
    )
    yield (
        MODEL,
        "no nodes",
        changed(lambda held: held.graph.ClearField("node")),
        ("is not a usable ONNX model"),
    )
    yield MODEL, "two inputs", changed(two_inputs), "has 2 inputs"
    yield MODEL, "an input of rank 3", model(node("Relu"), **relu), "[1, 3, H, W] is needed"
    byte = model(node("Cast", to=TensorProto.FLOAT), kind=TensorProto.UINT8)
    yield MODEL, "an input of bytes", byte, "float32 input"
    yield MODEL, "an output of rank 2", model(node("Flatten")), "[1, C, h, w] is needed"
    yield MODEL, "one feature a view", model(node("GlobalAveragePool")), "one feature every"
    yield MODEL, "weights outside", changed(outside), "has weights outside its folder"
    of_32 = all_of(partial(color_teacher, shape=(1, 3, 32, 32)), set_to("size", "[64, 64]"))
    yield MODEL, "another size than its graph", of_32, "says size = [64, 64]"
    yield MODEL, "multiple not met", halves(), "correct `size` or `multiple`"
    yield MODEL, "missing", remove(MODEL), "is missing"
    yield TOML, "missing", remove(TOML), "is missing"
    yield TABLE, "missing", remove(TABLE), "is missing; correct `labels`"
    yield TOML, "cut short", put(TOML, "mean = [0.5"), "does not parse"
    yield TOML, "nested", put(TOML, f"a = {DEEP}"), "nested too deeply"
    yield TOML, "no labels", set_to("labels", ""), "neither `labels` nor `text`"
    logits = all_of(set_to("labels", ""), set_to("output", '"logits"'))
    yield TOML, "no names of channels", logits, "names of the channels"
    yield "classes.txt", "too few classes", segmenter("red\ngreen\n"), "names 2 classes"
    yield (
        "classes.txt",
        "a class twice",
        segmenter("red\ngreen\nred\n"),
        ("line 3: a name is given twice"),
    )


def met(named: str, what: str, edit: Edit, word: str, code: int = 3, alone: bool = False) -> Row:
    """Asked for a picture of a room's size, and for the labels of a file where the edit has written
    one.
    """

    def build(folder: Path) -> Arguments:
        color_teacher(folder)
        picture("photo.png", (64, 48))(folder)
        edit(folder)
        labels = ["--labels", folder / "labels.txt"] if (folder / "labels.txt").exists() else []
        return ["check-teacher", folder / MODEL, "--photo", folder / "photo.png", *labels]

    return Row("teacher", f"{named}: {what}", build, (named, word), code, alone)


def many_channels(folder: Path) -> Arguments:
    color_teacher(folder, channels=65)
    write_table(folder / TABLE, embeddings=np.eye(3, 65))
    return stage(
        "teacher",
        folder,
        {"teacher": {"model": str(folder / MODEL)}},
        capture=artifacts() / "ingest",
    )


def rows() -> Iterator[Row]:
    for key, value, word in VALUES:
        yield met("tiny.", f"{key} = {value}", set_to(key, value), word)
    for named, what, edit, word in models():
        yield met(named, what, edit, word)
    for what, content, word in TABLES:
        yield met(TABLE, what, put(TABLE, content), word)
    for what, content, word in LABELS:
        yield met("labels.txt", what, put("labels.txt", content), word)
    yield Row(
        "teacher", f"{MODEL}: 65 channels", many_channels, (MODEL, "at most 64 can be rendered"), 2
    )
    yield met(MODEL, "nan", model(node("Log")), "non-finite values", 4)
    yield met(MODEL, "an output of 120 GB", huge(), "120,000,000,000 bytes; at most", 3, True)
    for factor in (100, 200, 400, 100_000):  # 0.37, 1.5, 5.9 GB, more than any machine has
        words = "bytes of memory are needed"
        yield met(
            MODEL, f"an output of {factor} times the image's sides", grown(factor), words, 3, True
        )
    yield met(MODEL, "constants of 3.6 GB", folded(), "bytes of memory are needed", 3, True)
    yield met(MODEL, "a loop of 2^62 steps", endless(), "not done after", 3, True)
    yield met(MODEL, "a pipe", no_file(MODEL, "pipe"), "is missing", 3, True)
    yield met(TABLE, "a zip bomb", bomb, "are read", 3, True)
