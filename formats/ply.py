"""3DGS PLY files: the 62-float layout that viewers load, trimmed to the SH bands in use.

`read_vertices` reads every PLY: counts in a header are checked against the file's size first.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from chebsplat.errors import InputError
from chebsplat.formats.files import regular
from chebsplat.formats.world import HERE, World

log = logging.getLogger("chebsplat")

REST = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients beyond band 0, by degree
_FIXED = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
_TAIL = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
HEADER = 1 << 20  # bytes that a header may take
THIN = 1e-3  # thickness of a 2DGS disc, relative to its smaller scale
# share of a file's Gaussians: beyond it the whole file counts as damaged
MOST_UNUSABLE = 0.5
_PART = re.compile(rb"^[ \t]*(?:element[ \t]+\S+[ \t]+(\d{1,30})|(property))\b", re.MULTILINE)


def write_ply(
    path: Path,
    parameters: dict[str, np.ndarray],
    degree: int,
    labels: np.ndarray | None = None,
    label_names: list[str] | None = None,
    world: World = HERE,
) -> None:
    """Write raw parameters (`formats.gaussians.Gaussians`) as a binary little-endian 3DGS PLY.

    Args:
      parameters: where `degrees` [N] are given, `sh_degree` follows `rot_3`.
      degree:     highest band to write; `f_rest` is channel-major and shorter below 3.
      labels:     [N] class ids, -1 none; `label` is then the last property.
      label_names: by id, written as comments `label ID NAME` of those that occur, in ASCII: what
        else a name holds is escaped as Python does (`caf\\xe9`); `labels.json` beside a scene's PLY
        has the names themselves.
      world:      of the parameters; the file has its source's.
    Choices: normals are written as zeros, since some loaders hard-code their presence. Tags are
      floats like all else: Open3D skips a `ushort`, and gsply 0.4 and spz-js 1.2 take any other
      type, or a second element, for the data. Only x, y, z are doubles, and only of a scene far
      from its source's origin, which floats would round to steps.
    """
    parameters = parameters | {
        "log_scales": parameters["log_scales"] + np.float32(np.log(world.scale))
    }
    n, n_rest = len(parameters["means"]), REST[degree]
    names = [*_FIXED, *(f"f_rest_{i}" for i in range(3 * n_rest)), *_TAIL]
    means = world.outward(parameters["means"])
    blocks = [
        means.astype(np.float32),
        np.zeros((n, 3), np.float32),
        parameters["sh0"][:, 0],
        parameters["shN"][:, :n_rest].transpose(0, 2, 1).reshape(n, -1),
        parameters["logit_opacities"][:, None],
        parameters["log_scales"],
        parameters["quats"],
    ]
    degrees = parameters.get("degrees")
    tags = {"sh_degree": None if degrees is None else np.minimum(degrees, degree), "label": labels}
    for name, values in tags.items():
        if values is not None:
            names.append(name)
            blocks.append(values[:, None])
    rows = np.concatenate(blocks, 1, dtype="<f4", casting="same_kind")
    table = rows.view([(name, "<f4") for name in names])[:, 0]
    if any(world.origin):
        table = table.astype([(name, "<f8" if name in _FIXED[:3] else "<f4") for name in names])
        for axis, name in enumerate(_FIXED[:3]):
            table[name] = means[:, axis]
    vertex = PlyElement.describe(table, "vertex")
    comments = []
    if labels is not None and label_names is not None:
        plain = [name.encode("unicode_escape").decode("ascii") for name in label_names]
        comments = [f"label {index} {plain[index]}" for index in np.unique(labels[labels >= 0])]
    PlyData([vertex], byte_order="<", comments=comments).write(str(path))


def read_ply(
    path: Path, world: World = HERE
) -> tuple[dict[str, np.ndarray], int, np.ndarray | None]:
    """Raw parameters, file degree, and labels or None. Normals and tags are optional.

    Args:   world: to bring the Gaussians into, from that of its source.
    Raises: InputError naming the file: not a PLY, truncated, not a 3DGS layout, or most values not
      finite.
    Choices: discs of two scales (2DGS) are THIN across them. The filter that mip-splatting, GOF and
      RaDe-GS keep beside the scales is fused into scales and opacities, as these export it.
      `drop_unusable` reports what is left out.
    """
    path = Path(path)
    vertex = read_vertices(path, "export the scene again")
    names = [p.name for p in vertex.properties]
    flat = "scale_2" not in names
    absent = [
        name
        for name in (*_FIXED[:3], *_FIXED[6:], *_TAIL)
        if name not in names and name != "scale_2"
    ]
    if absent:
        raise InputError(
            f"{path} has no property {absent[0]}: not an uncompressed 3DGS PLY; convert it first"
        )
    n_rest = sum(name.startswith("f_rest_") for name in names)
    degree = next((d for d, k in REST.items() if 3 * k == n_rest), None)
    if degree is None:
        raise InputError(f"{path} has {n_rest} f_rest properties; 0, 9, 24 or 45 are possible")

    def block(
        properties: list[str], inward: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> np.ndarray:
        with np.errstate(over="ignore"):  # of doubles; infinities are refused below
            return inward(np.stack([vertex[name] for name in properties], 1)).astype(np.float32)

    def whole(name: str, low: int, high: int) -> np.ndarray:
        values: np.ndarray = np.asarray(vertex[name])[finite]
        if not ((values >= low) & (values <= high) & (values == np.round(values))).all():
            raise InputError(
                f"{path}: {name} holds more than whole numbers {low} to {high}; "
                "export the scene again"
            )
        return values

    n = len(vertex.data)
    rest = block([f"f_rest_{i}" for i in range(n_rest)]) if n_rest else np.zeros((n, 0), np.float32)
    shN = np.zeros((n, 15, 3), np.float32)
    shN[:, : n_rest // 3] = rest.reshape(n, 3, n_rest // 3).transpose(0, 2, 1)
    parameters = {
        "means": block(_FIXED[:3], world.inward),
        "log_scales": block(_TAIL[1 : 3 if flat else 4]),
        "quats": block(_TAIL[4:]),
        "logit_opacities": block(["opacity"])[:, 0],
        "sh0": block(_FIXED[6:])[:, None],
        "shN": shN,
    }
    if flat:
        log.info(
            "%s holds discs of two scales, which are taken %g times as thick as wide", path, THIN
        )
        thin = parameters["log_scales"].min(1, keepdims=True) + np.float32(np.log(THIN))
        parameters["log_scales"] = np.concatenate([parameters["log_scales"], thin], 1)
    if "filter_3D" in names:
        log.info("%s: its filter_3D is fused into scales and opacities", path)
        parameters |= fuse_filter(
            parameters["log_scales"], parameters["logit_opacities"], np.asarray(vertex["filter_3D"])
        )
    parameters, finite = drop_unusable(path, parameters)
    parameters["log_scales"] -= np.float32(np.log(world.scale))
    if "sh_degree" in names:
        parameters["degrees"] = whole("sh_degree", 0, degree).astype(np.uint8)
    labels = whole("label", -1, 2**24).astype(np.int32) if "label" in names else None
    return parameters, degree, labels


def fuse_filter(
    log_scales: np.ndarray, logits: np.ndarray, size: np.ndarray
) -> dict[str, np.ndarray]:
    """Gaussians widened by an isotropic one of deviation `size` [N] (scene units), integral kept.

    Choices: scale² + size² for each scale², and opacities times the root of the ratio of the
      determinants, as mip-splatting fuses its 3D filter. log_scales [N, 3], logits [N]; float64
      within.
    """
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        wide = 0.5 * np.logaddexp(
            2 * log_scales.astype(float), 2 * np.log(np.abs(size.astype(float)))[:, None]
        )
        log_opacity = -np.logaddexp(0, -logits.astype(float)) + (log_scales - wide).sum(1)
        opacity = log_opacity - np.log(-np.expm1(log_opacity))
    return {"log_scales": wide.astype(np.float32), "logit_opacities": opacity.astype(np.float32)}


def drop_unusable(
    path: Path, parameters: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The parameters of finite Gaussians, and the mask [N] of these; a warning counts the rest.

    Raises:  InputError where there is none, or more than MOST_UNUSABLE are not finite.
    Choices: an infinite logit, which converters write for 8-bit opacities of exactly 0 or 1,
      becomes ±20: the same opacity in float32. A scale of 0, -inf as its logarithm, is left out:
      nothing can be computed of it. A quaternion of 0 is no rotation, as renderers have it.
    """
    logits, quats = parameters["logit_opacities"], parameters["quats"]
    if not len(logits):
        raise InputError(f"{path} holds no Gaussians; choose another")
    infinite = np.isinf(logits)
    parameters = parameters | {
        "logit_opacities": np.where(infinite, np.copysign(np.float32(20), logits), logits),
        "quats": np.where(quats.any(1, keepdims=True), quats, np.array([1, 0, 0, 0], np.float32)),
    }
    finite = {
        name: np.isfinite(values).reshape(len(values), -1).all(1)
        for name, values in parameters.items()
    }
    usable = np.logical_and.reduce(list(finite.values()))
    if usable.all():
        return parameters, usable
    worst = min(finite, key=lambda name: finite[name].sum())
    if usable.mean() < MOST_UNUSABLE:
        raise InputError(
            f"{path}: {worst} holds non-finite values in {(~usable).sum()} rows; "
            "export the scene again"
        )
    log.warning(
        "%s: %d of %d Gaussians are not finite (%s) and left out",
        path,
        (~usable).sum(),
        len(usable),
        worst,
    )
    return {name: values[usable] for name, values in parameters.items()}, usable


def read_vertices(path: Path, remedy: str) -> Any:
    """plyfile's element `vertex`, of scalar properties. Raises InputError naming file and remedy.

    Choices: a value takes a byte at least, in text and in binary; a header that declares more
      values than the file has bytes lies, and is refused before anything is allocated.
    """
    size = regular(path, remedy).st_size
    try:
        with path.open("rb") as handle:
            header, end, _ = handle.read(HEADER).partition(b"end_header")
        if not header.startswith(b"ply") or not end:
            raise ValueError("it has no PLY header")
        if (declared := _values(header)) > size:
            raise ValueError(f"it declares {declared:,} values and has {size:,} bytes")
        vertex = PlyData.read(str(path))["vertex"]
    except (
        PlyParseError,
        OSError,
        LookupError,
        TypeError,
        ValueError,
        MemoryError,
        OverflowError,
    ) as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is not a readable PLY ({line}); {remedy}") from None
    lists = [part.name for part in vertex.properties if isinstance(part, PlyListProperty)]
    if lists:
        raise InputError(
            f"{path}: {lists[0][:60]} holds lists, one number a vertex is needed; {remedy}"
        )
    return vertex


def _values(header: bytes) -> int:
    """Values that a header declares, a list counted as one."""
    total = count = 0
    for number, is_property in _PART.findall(header):
        if is_property:
            total += count
        else:
            count = int(number)
    return total
