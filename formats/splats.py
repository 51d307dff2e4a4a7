"""Splats of other programs: PLY, Niantic's SPZ, .splat, and the folder that 3DGS writes."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import regular
from chebsplat.formats.packed import C0
from chebsplat.formats.ply import REST, drop_unusable, read_ply
from chebsplat.formats.world import HERE, World

READ = (".ply", ".spz", ".splat")
OTHERS = (".ksplat", ".sog", ".sogs", ".lcc", ".rad")
REMEDY = "export it as PLY, for example with SuperSplat"
LARGEST = 512 << 20  # bytes of a .splat, and of an SPZ unpacked: 8 million Gaussians of degree 3
# magic, version, Gaussians, degree, bits of a coordinate's fraction, flags
SPZ = struct.Struct("<4sIIBBBx")
# SPZ looks along -z, y up: signs of the 15 coefficients beyond band 0 when y and z are negated
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def is_splat(name: str) -> bool:
    """True for a path that is named like a splat, or is a folder as 3DGS writes it."""
    return Path(name).suffix.lower() in READ + OTHERS or os.path.isdir(
        os.path.join(name, "point_cloud")
    )


def splat_file(path: Path) -> Path:
    """The file of a splat, or the last PLY of 3DGS' output folder. Raises InputError."""
    if os.path.isdir(path):
        iterations = [
            ply
            for ply in path.glob("point_cloud/iteration_*/point_cloud.ply")
            if _iteration(ply) >= 0
        ]
        if not iterations:
            raise InputError(
                f"{path} holds no point_cloud/iteration_*/point_cloud.ply; name the file of a splat"
            )
        return max(iterations, key=_iteration)
    if path.suffix.lower() in OTHERS:
        raise InputError(
            f"{path}: {path.suffix.lower()} is not read ({', '.join(READ)} are); {REMEDY}"
        )
    regular(path, "name the file of a splat")
    return path


def _iteration(ply: Path) -> int:
    number = ply.parent.name.removeprefix("iteration_")
    return int(number) if number.isdecimal() else -1


def read_splats(
    path: Path, world: World = HERE
) -> tuple[dict[str, np.ndarray], int, np.ndarray | None]:
    """Raw parameters, degree and labels, as `ply.read_ply`, of any splat that `splat_file` accepts.

    Args:   world: to bring the Gaussians into, from that of its source.
    Raises: InputError naming the file.
    """
    path = splat_file(Path(path))
    if path.suffix.lower() not in (".spz", ".splat"):
        return read_ply(path, world)
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has more than the {LARGEST >> 20} MiB that are read; thin it out")
    parameters, degree = (_spz if path.suffix.lower() == ".spz" else _splat)(path)
    parameters = drop_unusable(path, parameters)[0]
    moved = {
        "means": world.inward(parameters["means"]),
        "log_scales": parameters["log_scales"] - np.log(world.scale),
    }
    return (
        parameters | {name: values.astype(np.float32) for name, values in moved.items()},
        degree,
        None,
    )


def _splat(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Antimatter15's 32 bytes a Gaussian: centre, scales, RGBA, quaternion."""
    row = np.dtype(
        [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
    )
    data = path.read_bytes()
    if len(data) % row.itemsize:
        raise InputError(
            f"{path} is cut or no .splat: {len(data)} bytes are no multiple of 32; {REMEDY}"
        )
    rows = np.frombuffer(data, row)
    with np.errstate(divide="ignore", invalid="ignore"):  # scales of 0 and below
        log_scales = np.log(rows["scales"])
    return _parameters(
        rows["means"],
        log_scales,
        (rows["quats"].astype(np.float32) - 128) / 128,
        rows["rgba"][:, 3],
        (rows["rgba"][:, :3] / 255 - 0.5) / C0,
        np.zeros((len(rows), 0, 3)),
    ), 0


def _spz(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Niantic's SPZ, versions 2 and 3: gzip of planes of bytes. Axes become those of PLY files."""
    data = path.read_bytes()
    try:
        if data[:4] != b"NGSP":  # as version 4 begins
            data = zlib.decompressobj(31).decompress(data, LARGEST)
    except zlib.error as error:
        raise InputError(f"{path} is cut or no SPZ of version 2 or 3 ({error}); {REMEDY}") from None
    magic, version, n, degree, bits, _ = SPZ.unpack_from(data.ljust(SPZ.size, b"\0"))
    if magic != b"NGSP" or version not in (2, 3) or degree not in REST:
        raise InputError(
            f"{path} is no SPZ of version 2 or 3 ({magic!r}, version {version}); {REMEDY}"
        )
    widths = {
        "means": 9,
        "alphas": 1,
        "colors": 3,
        "scales": 3,
        "quats": version + 1,
        "sh": 3 * REST[degree],
    }
    if len(data) < SPZ.size + n * sum(widths.values()):
        raise InputError(
            f"{path} is cut, or has more than the {LARGEST >> 20} MiB that are read; {REMEDY}"
        )
    planes, at = {}, SPZ.size
    for name, width in widths.items():
        planes[name] = np.frombuffer(data, np.uint8, n * width, at).reshape(n, width)
        at += n * width
    coordinates = planes["means"].reshape(n, 3, 3).astype(np.int32)
    fixed = coordinates[..., 0] | coordinates[..., 1] << 8 | coordinates[..., 2] << 16
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed)
    quats = (_three_bytes if version == 2 else _smallest_three)(planes["quats"])
    return _parameters(
        fixed / 2.0**bits * [1, -1, -1],
        planes["scales"] / 16 - 10,
        quats * [1, 1, -1, -1],
        planes["alphas"][:, 0],
        (planes["colors"] / 255 - 0.5) / 0.15,
        (planes["sh"].reshape(n, -1, 3).astype(np.float32) / 128 - 1)
        * TURNED[: REST[degree], None],
    ), degree


def _three_bytes(stored: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] (wxyz) of x, y, z as bytes [N, 3]; w is not negative."""
    xyz = stored / 127.5 - 1
    return np.concatenate([np.sqrt((1 - (xyz**2).sum(1, keepdims=True)).clip(0)), xyz], 1)


def _smallest_three(stored: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] (wxyz) of u32 as bytes [N, 4]: the largest entry's place among x, y,
    z, w in the 2 upper bits, the others in order, each a sign and 9 bits over 1/√2.
    """
    words, rows = (
        np.ascontiguousarray(stored).view("<u4")[:, 0].astype(np.int64),
        np.arange(len(stored)),
    )
    place, xyzw = words >> 30, np.zeros((len(words), 4))
    for entry in (3, 2, 1, 0):
        here = place != entry
        value = (words & 511) / 511 * np.sqrt(0.5) * np.where(words & 512, -1, 1)
        xyzw[here, entry] = value[here]
        words = np.where(here, words >> 10, words)
    xyzw[rows, place] = np.sqrt((1 - (xyzw**2).sum(1)).clip(0))
    return xyzw[:, [3, 0, 1, 2]]


def _parameters(
    means: np.ndarray,
    log_scales: np.ndarray,
    quats: np.ndarray,
    alphas: np.ndarray,
    sh0: np.ndarray,
    sh: np.ndarray,
) -> dict[str, np.ndarray]:
    """Raw parameters; alphas: bytes [N]; sh0 [N, 3]; sh [N, K, 3]."""
    opacities = alphas / 255
    with np.errstate(divide="ignore"):  # 0 and 1
        logits = np.log(opacities / (1 - opacities))
    shN = np.zeros((len(means), 15, 3), np.float32)
    shN[:, : sh.shape[1]] = sh
    raw = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats,
        "logit_opacities": logits,
        "sh0": sh0[:, None],
    }
    return {name: values.astype(np.float32) for name, values in raw.items()} | {"shN": shN}
