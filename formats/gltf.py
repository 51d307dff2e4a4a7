"""GLB: one primitive of triangles, or of Gaussians by glTF's KHR_gaussian_splatting.

Gaussians look along z, y up: half a turn about x from the axes of PLY files. What they mean is told
by EXT_mesh_features, a row of meanings each (`_FEATURE_ID_0`), and EXT_structural_metadata: a table
of meanings and one of classes, each row with `label`, an enumeration of the classes' names, and
`feature`, f32 [C].
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import LARGEST
from chebsplat.formats.names import check_names
from chebsplat.formats.packed import C0, raw_parameters
from chebsplat.formats.ply import REST
from chebsplat.formats.semantics import Semantics
from chebsplat.formats.spz import REMEDY, TURNED
from chebsplat.formats.world import HERE, World

KINDS = {
    "float32": 5126,
    "uint32": 5125,
    "uint16": 5123,
    "uint8": 5121,
    "int16": 5122,
    "int8": 5120,
}
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963  # targets of buffer views
HEADER = struct.Struct("<4sII")
CHUNK = struct.Struct("<I4s")
SPLAT = "KHR_gaussian_splatting"
COLORS = "srgb_rec709_display"
IDS, TABLES = "EXT_mesh_features", "EXT_structural_metadata"
SCHEMA = "chebsplat"  # id of the tables' schema
NO_LABEL = "(none)"  # name of -1 in the enumeration of labels
SINGLE = np.finfo(np.float32)
# components of attributes, and the integers, normalised, that each may be stored as
SIGNED, UNSIGNED = ("int8", "int16"), ("uint8", "uint16")
PARTS: dict[str, tuple[int, tuple[str, ...]]] = {
    "POSITION": (3, ()),
    f"{SPLAT}:SCALE": (3, SIGNED),
    f"{SPLAT}:ROTATION": (4, SIGNED),
    f"{SPLAT}:OPACITY": (1, UNSIGNED),
}
DAMAGED = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OSError,
    OverflowError,
    RecursionError,
    struct.error,
)


def write_glb(
    path: Path,
    attributes: dict[str, np.ndarray],
    primitive: dict[str, Any],
    indices: np.ndarray | None = None,
    names: list[str] | None = None,
    tables: tuple[np.ndarray, ...] = (),
    **more: Any,
) -> None:
    """Write one mesh of one primitive.

    Args: attributes: [V] or [V, 3 or 4] by name, f32, or u16 of [0, 1]; primitive: its
      other members; indices: u32 of triangles; names: of labels; tables: f32 or i32, buffer views
      after those of attributes; more: members of the document.
    """
    parts = attributes | ({} if indices is None else {"indices": indices})
    views: list[dict[str, int]] = []
    accessors, offset = [], 0
    for k, (name, values) in enumerate(parts.items()):
        views.append(
            {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": values.nbytes,
                "target": INDICES if name == "indices" else VERTICES,
            }
        )
        accessor = {
            "bufferView": k,
            "componentType": KINDS[values.dtype.name],
            "count": len(values),
            "type": SHAPES[values[:1].size],
        }
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor | ({"normalized": True} if values.dtype == np.uint16 else {}))
        offset += values.nbytes
    for values in tables:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes})
        offset += values.nbytes
    primitive = {"attributes": {name: k for k, name in enumerate(attributes)}} | primitive
    if indices is not None:
        primitive["indices"] = len(attributes)
    document = {
        "asset": {"version": "2.0", "generator": "chebsplat"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], "extras": {"label_names": names or []}}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document | more).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as stream:
        stream.write(HEADER.pack(b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        stream.write(CHUNK.pack(len(text), b"JSON") + text)
        stream.write(CHUNK.pack(offset, b"BIN\0"))
        for values in (*parts.values(), *tables):
            stream.write(np.ascontiguousarray(values).tobytes())


def linear_light(srgb: np.ndarray, alpha: np.ndarray | float = 1.0) -> np.ndarray:
    """COLOR_0, u16 [V, 4]: display colours [V, 3] of [0, 1] in linear light, and alpha [V]."""
    light = np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)
    with_alpha = np.concatenate([light, np.broadcast_to(alpha, len(srgb))[:, None]], 1)
    stored: np.ndarray = np.rint(65535 * with_alpha).astype(np.uint16)
    return stored


def write_splat_glb(
    path: Path,
    parameters: dict[str, np.ndarray],
    degree: int,
    semantics: Semantics | None = None,
    world: World = HERE,
) -> None:
    """Write raw parameters (`formats.gaussians.Gaussians.parameters`); args as of `ply.write_ply`.

    Choices: viewers without the extension draw points in COLOR_0. Sizes beyond float32 become its
      least and largest, for of a size of 0 no reader can compute.
    """
    from scipy.special import expit  # a command that only asks for help needs none

    means = (world.outward(parameters["means"]) * [1, -1, -1]).astype(np.float32)
    unit = parameters["quats"].astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True).clip(1e-300)
    unit *= [1, 1, -1, -1]
    opacities = expit(parameters["logit_opacities"].astype(np.float64))
    sizes = world.scale * np.exp(parameters["log_scales"].astype(np.float64))
    display = (parameters["sh0"][:, 0].astype(np.float64) * C0 + 0.5).clip(0, 1)
    attributes = {
        "POSITION": means,
        "COLOR_0": linear_light(display, opacities),
        f"{SPLAT}:ROTATION": unit[:, [1, 2, 3, 0]].astype(np.float32),
        f"{SPLAT}:SCALE": sizes.clip(SINGLE.tiny, SINGLE.max).astype(np.float32),
        f"{SPLAT}:OPACITY": opacities.astype(np.float32),
    }
    light = np.concatenate([parameters["sh0"], parameters["shN"] * TURNED[:, None]], 1)
    for k, name in enumerate(_light_names(degree)):
        attributes[name] = light[:, k]
    kernel = {
        "kernel": "ellipse",
        "colorSpace": COLORS,
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    extensions: dict[str, Any] = {SPLAT: kernel}
    tables: tuple[np.ndarray, ...] = ()
    more: dict[str, Any] = {}
    if semantics is not None:
        attributes["_FEATURE_ID_0"] = semantics.meanings.astype(np.float32)
        ids = {"featureCount": len(semantics.labels), "attribute": 0, "propertyTable": 0}
        extensions[IDS] = {"featureIds": [ids]}
        tables = (
            semantics.labels.astype(np.int32),
            semantics.features,
            np.arange(len(semantics.names), dtype=np.int32),
            semantics.embeddings.astype(np.float32),
        )
        more["extensions"] = {TABLES: _metadata(semantics, len(attributes))}
    used = [*extensions, *more.get("extensions", {})]
    primitive = {"mode": 0, "extensions": extensions}
    write_glb(path, attributes, primitive, tables=tables, extensionsUsed=used, **more)


def _light_names(degree: int) -> list[str]:
    """Attributes of the coefficients, in order, up to a degree."""
    return [
        f"{SPLAT}:SH_DEGREE_{band}_COEF_{k}"
        for band in range(degree + 1)
        for k in range(2 * band + 1)
    ]


def _metadata(semantics: Semantics, first: int) -> dict[str, Any]:
    """EXT_structural_metadata of tables in four buffer views from `first` on."""
    labels = [{"name": name, "value": k} for k, name in enumerate([NO_LABEL, *semantics.names], -1)]
    feature = {"type": "SCALAR", "componentType": "FLOAT32", "array": True}
    properties = {
        "label": {"type": "ENUM", "enumType": "label", "noData": NO_LABEL},
        "feature": feature | {"count": semantics.features.shape[1]},
    }
    return {
        "schema": {
            "id": SCHEMA,
            "enums": {"label": {"valueType": "INT32", "values": labels}},
            "classes": {"meaning": {"properties": properties}},
        },
        "propertyTables": [
            {
                "class": "meaning",
                "count": count,
                "properties": {"label": {"values": at}, "feature": {"values": at + 1}},
            }
            for count, at in ((len(semantics.labels), first), (len(semantics.names), first + 2))
        ],
    }


class _Opened:
    """A GLB of one primitive of Gaussians: its document, the bytes after it, the primitive.

    Raises: ValueError, or another of DAMAGED, where it is none.
    """

    def __init__(self, path: Path):
        data = path.read_bytes()
        magic, version, _ = HEADER.unpack_from(data)
        length, kind = CHUNK.unpack_from(data, HEADER.size)
        if (magic, version, kind) != (b"glTF", 2, b"JSON"):
            raise ValueError("it has no header of glTF 2")
        start = HEADER.size + CHUNK.size
        if length > LARGEST:
            raise ValueError(f"its document has {length:,} bytes, at most {LARGEST:,} are read")
        self.document: dict[str, Any] = json.loads(data[start : start + length])
        if unknown := {*self.document.get("extensionsRequired", [])} - {SPLAT, IDS, TABLES}:
            raise ValueError(f"it needs {', '.join(sorted(unknown))}")
        self.binary = data[start + length + CHUNK.size :]
        primitives = [
            primitive
            for mesh in self.document.get("meshes", [])
            for primitive in mesh["primitives"]
            if SPLAT in primitive.get("extensions", {})
        ]
        if len(primitives) != 1:
            raise ValueError(f"it has {len(primitives)} primitives of Gaussians, one is read")
        self.primitive: dict[str, Any] = primitives[0]
        kernel = primitives[0]["extensions"][SPLAT]
        if kernel.get("extensions"):
            raise ValueError(f"its Gaussians are packed by {', '.join(kernel['extensions'])}")
        if (kernel.get("kernel"), kernel.get("colorSpace")) != ("ellipse", COLORS):
            raise ValueError(f"kernel {kernel.get('kernel')}, colours {kernel.get('colorSpace')}")
        for node in self.document.get("nodes", []):
            if node.keys() & {"matrix", "rotation", "scale", "translation"}:
                raise ValueError("a node of it is moved")

    def attribute(self, name: str, width: int, integers: tuple[str, ...] = ()) -> np.ndarray:
        """An attribute of the primitive, f64 [V, width]; integers: kinds that may stand for it."""
        if name not in self.primitive["attributes"]:
            raise ValueError(f"it has no {name}")
        accessor = self.document["accessors"][self.primitive["attributes"][name]]
        kinds = {KINDS[kind]: kind for kind in ("float32", *integers)}
        kind = kinds.get(accessor["componentType"])
        normalized = accessor.get("normalized", False)
        if kind is None or accessor["type"] != SHAPES[width] or normalized == (kind == "float32"):
            raise ValueError(
                f"{name} is {accessor['type']} of {accessor['componentType']}"
                f"{', normalized' if normalized else ''}"
            )
        dtype = np.dtype(kind).newbyteorder("<")
        row = width * dtype.itemsize
        if "sparse" in accessor:
            raise ValueError(f"{name} is sparse")
        view = self._view(accessor["bufferView"])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = max(view.get("byteStride", row), row), dtype.itemsize
        shape = accessor["count"], width
        values = np.ndarray(shape, dtype, self.binary, start, strides).astype(np.float64)
        return values if kind == "float32" else (values / np.iinfo(kind).max).clip(-1)

    def column(self, table: int, name: str, kind: str) -> np.ndarray:
        """A property of a table, [rows, numbers of a row]."""
        rows = self.document["extensions"][TABLES]["propertyTables"][table]
        view = self._view(rows["properties"][name]["values"])
        start = view.get("byteOffset", 0)
        values = np.frombuffer(self.binary[start : start + view["byteLength"]], kind)
        return values.reshape(rows["count"], -1)

    def _view(self, number: int) -> dict[str, Any]:
        """A buffer view of the file's own bytes."""
        view: dict[str, Any] = self.document["bufferViews"][number]
        if view["buffer"] != 0 or "uri" in self.document["buffers"][0]:
            raise ValueError("its numbers lie in another file")
        return view


def read_splat_glb(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Raw parameters in the axes of PLY files, and the degree. Raises InputError with the path."""
    try:
        glb = _Opened(path)
        attributes = glb.primitive["attributes"]
        degree = max(d for d in REST if d == 0 or f"{SPLAT}:SH_DEGREE_{d}_COEF_0" in attributes)
        means, scales, quats, opacities = (glb.attribute(name, *PARTS[name]) for name in PARTS)
        light = np.stack([glb.attribute(name, 3) for name in _light_names(degree)], 1)
        if not (scales >= 0).all() or not ((opacities >= 0) & (opacities <= 1)).all():
            raise ValueError("sizes below 0, or opacities beyond 0 to 1")
        if any(len(values) != len(means) for values in (scales, quats, opacities, light)):
            raise ValueError("its attributes are of different lengths")
    except DAMAGED as error:
        raise _refused(path, error) from None
    with np.errstate(divide="ignore"):  # sizes of 0
        log_scales = np.log(scales)
    return raw_parameters(
        means * [1, -1, -1],
        log_scales,
        quats[:, [3, 0, 1, 2]] * [1, 1, -1, -1],
        255 * opacities[:, 0],
        light[:, 0],
        light[:, 1:] * TURNED[: REST[degree], None],
    ), degree


def read_meanings(path: Path) -> Semantics | None:
    """The meanings that a GLB of Gaussians has of them; None where they are not in our form.

    Raises: InputError with the path.
    """
    try:
        glb = _Opened(path)
        metadata = glb.document.get("extensions", {}).get(TABLES, {})
        if metadata.get("schema", {}).get("id") != SCHEMA:
            return None
        values = metadata["schema"]["enums"]["label"]["values"]
        with np.errstate(invalid="ignore"):  # of what is no number, and no row
            meanings = glb.attribute("_FEATURE_ID_0", 1)[:, 0].astype(np.int64)
        names = [value["name"] for value in values if value["value"] >= 0]
        check_names(names, "names of classes", path, f"name another splat, or {REMEDY}")
        return Semantics(
            meanings,
            glb.column(0, "label", "<i4")[:, 0],
            glb.column(0, "feature", "<f4"),
            names,
            glb.column(1, "feature", "<f4"),
        )
    except DAMAGED as error:
        raise _refused(path, error) from None


def _refused(path: Path, error: Exception) -> InputError:
    line = " ".join(str(error).split())[:200]
    return InputError(
        f"{path} is no GLB of Gaussians that is read ({line}); name another splat, or {REMEDY}"
    )
