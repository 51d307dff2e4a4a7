"""Uses of a finished scene with what does not belong to it: encode, extract, query, verify."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from malformed.artifacts import copied, resealed, set_value
from malformed.case import Asked, Case

PLAIN = ("settings", "described")  # with false, nothing has to be described before a model is opened
CONTRACT: list[tuple[tuple[str, ...], Any]] = [  # keys of contract.json and what they are given (...: taken away)
    ((), []), (("settings",), ...), (("settings",), 5), (("settings", "describe"), ...), (("settings", "describe"), []),
    (("settings", "describe", "n_regions"), 10**9), (("settings", "describe", "n_regions"), -1),
    (("settings", "describe", "spectrum"), "half"), (("settings", "describe", "bandwidth"), float("nan")),
    (("settings", "describe", "colour"), 1), (("settings", "n_covers"), -1), (("settings", "n_covers"), "2"),
    (("settings", "n_covers"), ...), (("settings", "n_channels"), 7), (("settings", "n_channels"), "5"),
    (("settings", "described"), "yes"), (("settings", "context"), 5),
]  # fmt: skip
FEATURES: dict[str, Callable[[Path], Any]] = {  # how features.npy is written
    "empty": lambda file: file.write_bytes(b""),
    "text": lambda file: file.write_text("no array"),
    "terabytes declared": lambda file: _declared(file, (10**6, 10**6)),
    "pickled": lambda file: file.write_bytes(pickle.dumps([1, 2])),
    "of objects": lambda file: np.save(file, np.array([{}, None], object), allow_pickle=True),
    "of one dimension": lambda file: np.save(file, np.zeros(40, np.float32)),
    "of other rows": lambda file: np.save(file, np.zeros((3, 5), np.float32)),
    "of other channels": lambda file: np.save(file, np.zeros((40, 4), np.float32)),
    "nan": lambda file: np.save(file, np.full((40, 5), np.nan, np.float32)),
    "words": lambda file: np.save(file, np.full((40, 5), "a")),
    "a pipe": lambda file: os.mkfifo(file),
    "a folder": lambda file: file.mkdir(),
    "a loop": lambda file: file.symlink_to(file.name),
}


def _declared(file: Path, shape: tuple[int, ...]) -> None:
    with file.open("wb") as handle:
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f4", "fortran_order": False, "shape": shape})


def _contract(keys: tuple[str, ...], value: Any) -> Case:
    def build(folder: Path) -> Asked:
        encoder = copied("onnx", folder)
        set_value(encoder / "contract.json", keys, value)
        resealed(encoder)
        arguments = ["encode", copied("export", folder), "--encoder", encoder, "--out", folder / "features.npz"]
        return Asked(arguments, "contract" if keys != ("settings", "n_channels") or value != 7 else "channels")

    said = "gone" if value is ... else repr(value)
    return Case("encode", f"contract.json: {'.'.join(keys) or 'all'} = {said}", build, (3,))


def _model(name: str, content: bytes) -> Case:
    def build(folder: Path) -> Asked:
        encoder = copied("onnx", folder)
        set_value(encoder / "contract.json", PLAIN, False)
        (encoder / name).write_bytes(content)
        resealed(encoder)
        arguments = ["encode", copied("export", folder), "--encoder", encoder, "--out", folder / "features.npz"]
        return Asked(arguments, ".onnx")

    return Case("encode", f"{name} = {content[:12]!r}", build, (3,))


def _features(what: str, write: Callable[[Path], Any]) -> Case:
    def build(folder: Path) -> Asked:
        file = folder / "features.npy"
        write(file)
        scene = copied("export", folder) / "scene.ply"
        arguments = ["encode", scene, "--encoder", copied("onnx", folder), "--features", file]
        return Asked([*arguments, "--out", folder / "features.npz"], "features.npy")

    return Case("encode", f"features that are {what}", build, (3,))


def _unsealed(command: str, what: str, spoil: Callable[[Path], Any]) -> Case:
    """An artifact that was changed behind its manifest's back."""

    def build(folder: Path) -> Asked:
        scene = copied("export", folder)
        spoil(scene)
        more = {"extract": ["--out", folder / "part.ply"], "verify": [], "encode": ["--out", folder / "a.npz"]}[command]
        encoder = ["--encoder", copied("onnx", folder)] if command == "encode" else []
        return Asked([command, scene, *encoder, *more], "export")

    return Case(command, what, build, (3,))


SPOILS: dict[str, Callable[[Path], Any]] = {
    "labels.json gone": lambda scene: (scene / "labels.json").unlink(),
    "labels.json a folder": lambda scene: ((scene / "labels.json").unlink(), (scene / "labels.json").mkdir()),
    "labels.json longer": lambda scene: (scene / "labels.json").write_text("{}" * 100),
    "another degrees.safetensors": lambda scene: _flipped(scene / "degrees.safetensors"),
    "ragged gone": lambda scene: shutil.rmtree(scene / "ragged"),
    "no manifest": lambda scene: (scene / "artifact.json").unlink(),
    "a cut manifest": lambda scene: (scene / "artifact.json").write_text('{"schema": '),
}


def _flipped(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))


def cases() -> Iterator[Case]:
    for keys, value in CONTRACT:
        yield _contract(keys, value)
    for name in ("encoder.onnx", "fusion.onnx"):
        for content in (b"", b"no model", b"\x08\x07" * 40):
            yield _model(name, content)
    for what, write in FEATURES.items():
        yield _features(what, write)
    for command in ("extract", "verify", "encode"):
        for what, spoil in SPOILS.items():
            yield _unsealed(command, what, spoil)
