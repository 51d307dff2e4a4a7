"""GLB: one primitive of triangles, or of Gaussians by glTF's KHR_gaussian_splatting."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats.packed import C0
from chebsplat.formats.ply import REST
from chebsplat.formats.world import HERE, World

KINDS = {"float32": 5126, "uint32": 5125, "uint16": 5123}
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963  # targets of buffer views
SPLAT = "KHR_gaussian_splatting"


def write_glb(
    path: Path,
    attributes: dict[str, np.ndarray],
    primitive: dict[str, Any],
    indices: np.ndarray | None = None,
    names: list[str] | None = None,
    **more: Any,
) -> None:
    """Write one mesh of one primitive.

    Args: attributes: [V] or [V, 3 or 4] by name, f32, or u16 of [0, 1]; primitive: its
      other members; indices: u32 of triangles; names: of labels; more: members of the document.
    """
    parts = attributes | ({} if indices is None else {"indices": indices})
    views, accessors, offset = [], [], 0
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
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", offset, b"BIN\0"))
        for values in parts.values():
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
    labels: np.ndarray | None = None,
    label_names: list[str] | None = None,
    world: World = HERE,
) -> None:
    """Write raw parameters (`formats.gaussians.Gaussians.parameters`); args as of `ply.write_ply`.

    Choices: glTF is y up and in metres: the caller rotates. Viewers without the extension draw
      points in COLOR_0. Labels are the attribute `_LABEL`, -1 for none, as in a mesh.
    """
    from scipy.special import expit  # a command that only asks for help needs none

    means = world.outward(parameters["means"]).astype(np.float32)
    unit = parameters["quats"].astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True).clip(1e-300)
    opacities = expit(parameters["logit_opacities"].astype(np.float64))
    display = (parameters["sh0"][:, 0].astype(np.float64) * C0 + 0.5).clip(0, 1)
    attributes = {
        "POSITION": means,
        "COLOR_0": linear_light(display, opacities),
        f"{SPLAT}:ROTATION": unit[:, [1, 2, 3, 0]].astype(np.float32),
        f"{SPLAT}:SCALE": (world.scale * np.exp(parameters["log_scales"])).astype(np.float32),
        f"{SPLAT}:OPACITY": opacities.astype(np.float32),
        f"{SPLAT}:SH_DEGREE_0_COEF_0": parameters["sh0"][:, 0],
    }
    for band in range(1, degree + 1):
        for k in range(REST[band - 1], REST[band]):
            name = f"{SPLAT}:SH_DEGREE_{band}_COEF_{k - REST[band - 1]}"
            attributes[name] = parameters["shN"][:, k]
    if labels is not None:
        attributes["_LABEL"] = labels.astype(np.float32)
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {"mode": 0, "extensions": {SPLAT: extension}}
    write_glb(path, attributes, primitive, names=label_names, extensionsUsed=[SPLAT])
