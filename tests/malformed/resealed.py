"""Artifacts whose digests are right and whose content is garbage: every reader holds them to what it promises."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from malformed.artifacts import LABELS, VIEWS, copied, resealed, set_tensor, set_value
from malformed.case import Asked, Case, stage

CONFIG = {"teacher": {"kind": "labels", "n_channels": 5}, "describe": {"n_angles": 2, "max_degree": 3}}
READERS: dict[str, tuple[str, dict[str, str]]] = {  # stage of the artifact: the stage that reads it, its other inputs
    "ingest": ("teacher", {}),
    "sfm": ("describe", {}),
    "teacher": ("export", {"gaussians": "train"}),
    "describe": ("train", {"capture": "ingest", "points": "sfm"}),
    "train": ("export", {}),
    "lift": ("refine", {"gaussians": "train", "features": "teacher"}),
    "refine": ("export", {"gaussians": "train", "features": "teacher"}),
    "export": ("extract", {}),
    "cks": ("cks", {"gaussians": "train"}),
    "evaluate": ("report", {"gaussians": "train"}),
}
ROLES = {"ingest": "capture", "sfm": "points", "teacher": "features", "describe": "descriptors", "train": "gaussians",
         "lift": "lifted", "refine": "refined", "export": "scene", "cks": "basis", "evaluate": "evaluation",
         "onnx": "encoder"}  # fmt: skip
Damage = Callable[[Path], None]
DOCUMENTS: dict[str, dict[str, list[tuple[tuple[Any, ...], Any]]]] = {  # stage, file: keys and value (...: taken away)
    "ingest": {
        "capture.json": [
            ((), []), ((), 5), (("names",), 5), (("names",), [1, 2, 3]), (("names",), VIEWS[:1] * 3),
            (("names",), VIEWS[:2]), (("names",), ["a\0b", "b", "c"]), (("names",), ["", "b", "c"]), (("names",), ...),
            (("class_names",), "wall"), (("class_names",), [["wall"]]), (("class_names",), LABELS[:1]),
            (("class_names",), None), (("class_names",), ["x" * 5000, "b", "c"]), (("source",), []),
            (("protocol",), "labels"),
        ],
    },
    "teacher": {
        "features.json": [
            ((), None), (("names",), {}), (("names",), VIEWS * 2), (("label_names",), LABELS[:2]),
            (("label_names",), ["a", "a", "b"]), (("label_names",), [0, 1, 2]), (("convention",), []),
            (("projection",), 5), (("projection",), {"teacher": "a"}),
        ],
    },
    "train": {
        "notes.json": [((), []), (("left_out",), ["a"]), (("n_initial",), -5), (("encoder",), 5),
                       (("encoder", "width"), 10**9), (("encoder", "n_layers"), -1), (("encoder", "n_inputs"), ...)],
        "cameras.json": [(("names",), 3), (("width",), 0), (("width",), 10**9), (("height",), "16"), ((), None)],
    },
    "lift": {"notes.json": [((), []), (("views",), 5), (("n_observations",), -1), (("n_observations",), ...)]},
    "refine": {"notes.json": [((), []), (("smooth",), 5), (("strength",), -1), (("start",), "a"), (("curve",), ...),
                              (("curve", "on", "0"), 7)]},
    "export": {
        "summary.json": [((), []), (("bytes",), 5), (("bytes", "ply"), -1), (("n",), "40"), (("left_out",), [1])],
        "labels.json": [((), []), ((), {"0": "a"}), ((), {"0": "a", "1": "b", "5": "c"}),
                        ((), {"0": "a", "1": "a", "2": "b"}), ((), {"0": 5, "1": "b", "2": "c"})],
        "cameras.json": [(("names",), VIEWS[:1]), (("height",), 1.5)],
    },
    "evaluate": {
        "figures.json": [
            ((), []), (("image", "psnr"), float("nan")), (("image", "psnr"), "20"), (("image", "psnr"), None),
            (("image",), ...), (("image", "per_view", "psnr"), []), (("names",), []), (("names",), VIEWS),
            (("n_gaussians",), -1), (("bytes", "ply"), ...), (("bytes", "unpruned_ply"), 0), (("left_out",), []),
            (("frames_per_second",), {"colour": 5.0}), (("milliseconds",), {"projection": "a"}), (("protocol",), {}),
            (("source",), ...), (("lpips",), "low"), (("segmentation", "scene", "miou"), 7.0),
            (("segmentation", "scene", "iou"), {"wall": "a"}), (("segmentation", "classes"), "wall"),
            (("segmentation", "classes"), []),
        ],
    },
    "describe": {"settings.json": [((), []), (("radius",), ...), (("radius",), -1.0), (("n_angles",), 4)]},
    "cks": {
        "lineage.json": [
            ((), {}), ((0,), 5), ((0, "scene"), ...), ((0, "maps"), []), ((0, "spread"), ...), ((), [])
        ],
    },
}  # fmt: skip


def _put(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array.flat[0] = value
        return array

    return change


NAN = _put(float("nan"))
GONE: Callable[[np.ndarray], None] = lambda array: None  # noqa: E731
SHORT: Callable[[np.ndarray], np.ndarray] = lambda array: array[:-1]  # noqa: E731
WIDE: Callable[[np.ndarray], np.ndarray] = lambda array: np.concatenate([array, array], -1)  # noqa: E731
DOUBLE: Callable[[np.ndarray], np.ndarray] = lambda array: array.astype(np.float16)  # noqa: E731
TENSORS: dict[str, dict[str, dict[str, dict[str, Any]]]] = {  # stage, file, array: what is wrong
    "ingest": {
        "cameras.safetensors": {
            "Ks": {"nan": NAN, "a view short": SHORT, "a focal length of 0": _put(0), "half": DOUBLE, "gone": GONE},
            "cam_from_world": {"nan": NAN, "no rotation": _put(2), "mirrored": _put(-1), "3x4": lambda a: a[:, :3]},
            "is_test": {"a view short": SHORT, "half": DOUBLE},
        },
    },
    "teacher": {"labels.safetensors": {"embeddings": {"nan": NAN, "wide": WIDE, "long": _put(9), "short": SHORT}}},
    "train": {
        "parameters.safetensors": {
            "log_scales": {"nan": NAN, "infinite": _put(float("inf")), "short": SHORT},
            "means": {"half": DOUBLE, "gone": GONE, "wide": WIDE},
            "degrees": {"beyond 3": _put(200), "short": SHORT},
            "shN": {"half a band": lambda a: np.zeros((len(a), 2, 3), np.float32)},
            "features": {"short": SHORT, "wide": WIDE},
        },
        "cameras.safetensors": {"cam_from_world": {"no rotation": _put(5), "last row": lambda a: a * 2}},
    },
    "export": {
        "labels.safetensors": {
            "labels": {"999": _put(999), "-5": _put(-5), "short": SHORT, "half": DOUBLE},
            "embeddings": {"wide": WIDE, "nan": NAN},
        },
        "degrees.safetensors": {"degrees": {"7": _put(7), "none": lambda a: a[:0], "short": SHORT}},
        "cameras.safetensors": {"Ks": {"0": _put(0), "gone": GONE}},
    },
    "describe": {
        "descriptors.safetensors": {
            "members": {"-7": _put(-7), "999": _put(999), "narrow": lambda a: a[:, :3]},
            "centers": {"-1": _put(-1), "999": _put(999)},
            "values": {"nan": NAN, "wide": WIDE},
        },
    },
    "sfm": {"points.safetensors": {"means": {"nan": NAN, "short": SHORT}, "cam_from_world": {"no rotation": _put(3)}}},
    "cks": {"bases.safetensors": {"blocks.0.query": {"nan": NAN, "not orthonormal": _put(3), "flat": lambda a: a[0]}}},
}
ARRAYS = {  # stage: an array
    "ingest": "images",
    "teacher": "features",
    "export": "ragged/means",
    "evaluate": "renders",
}
METADATA: dict[str, tuple[tuple[Any, ...], Any]] = {  # what is wrong with an array's zarr.json
    "a shape of 1e9 squared": (("shape",), [10**9, 10**9]),
    "a shape of 1e9 in every dimension": (("shape", 0), 10**9),
    "a negative shape": (("shape", 0), -1),
    "a shape of text": (("shape",), "3"),
    "chunks of 0": (("chunk_grid", "configuration", "chunk_shape", 0), 0),
    "chunks of 1e12": (("chunk_grid", "configuration", "chunk_shape", 1), 10**12),
    "no chunks": (("chunk_grid",), {}),
    "another dtype": (("data_type",), "float64"),
    "an odd dtype": (("data_type",), "object"),
    "an odd codec": (("codecs",), [{"name": "numcodecs.pickle"}]),
    "no codecs": (("codecs",), []),
    "no object": ((), []),
    "another format": (("zarr_format",), 2),
}


def _case(of: str, name: str, damage: Damage, named: str) -> Case:
    reader, others = READERS[of]

    def build(folder: Path) -> Asked:
        path = copied(of, folder)
        damage(path)
        resealed(path)
        if of == "export":
            return Asked(["extract", path, "--out", folder / "out.ply"], named)
        inputs = {ROLES[of]: path} | {role: copied(other, folder) for role, other in others.items()}
        return stage(reader, folder, CONFIG, named, **inputs)

    return Case(f"resealed {of}", name, build, (3,))


def cases() -> Iterator[Case]:
    for of, files in DOCUMENTS.items():
        for file, values in files.items():
            for keys, value in values:
                where = ".".join(map(str, keys)) or "all"
                said = "gone" if value is ... else repr(value)[:30]

                def edit(path: Path, file: str = file, keys: Any = keys, value: Any = value) -> None:
                    set_value(path / file, keys, value)

                yield _case(of, f"{file}: {where} = {said}", edit, of)
    for of, tensors in TENSORS.items():
        for file, arrays in tensors.items():
            for array, changes in arrays.items():
                for what, change in changes.items():

                    def put(path: Path, file: str = file, array: str = array, change: Any = change) -> None:
                        set_tensor(path / file, array, change)

                    yield _case(of, f"{file}: {array}: {what}", put, of)
    for of, array in ARRAYS.items():
        for what, (keys, value) in METADATA.items():

            def declare(path: Path, array: str = array, keys: Any = keys, value: Any = value) -> None:
                set_value(path / array / "zarr.json", keys, value)

            yield _case(of, f"{array}: {what}", declare, array)
    trace = {"nan": "step,seconds,psnr\n1,nan,20\n", "words": "step,seconds,psnr\n1,a,20\n", "no psnr": "step\n1\n",
             "a cell too many": "step,seconds,psnr\n1,2,3,4\n", "binary": "\0\0"}  # fmt: skip
    for what, text in trace.items():
        yield _case(
            "train", f"trace.csv: {what}", lambda path, text=text: _write(path / "trace.csv", text), "trace.csv"
        )


def _write(file: Path, text: str) -> None:
    file.write_text(text)
