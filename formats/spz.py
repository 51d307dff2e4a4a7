"""Niantic's SPZ, gzip of planes of bytes: read in versions 2 to 4, written in 3 (older viewers).

SPZ looks along -z, y up: half a turn about x from the axes of PLY files.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
from numcodecs.zstd import Zstd

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.packed import along_a_curve, drawn_near, raw_parameters
from chebsplat.formats.ply import REST
from chebsplat.formats.world import HERE, World

REMEDY = "export it as PLY, for example with SuperSplat"
LARGEST = 512 << 20  # bytes unpacked: 8 million Gaussians of degree 3
# magic, version, Gaussians, degree, bits of a coordinate's fraction, flags
HEADER = struct.Struct("<4sIIBBBx")
HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # then number of streams, offset of sizes
SIZES = struct.Struct("<QQ")  # of a stream: compressed, plain
# signs of the 15 coefficients beyond band 0 when y and z are negated
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
# quantisation that the format leaves to the writer; figures in docs/usage.md
FINE = 3.0  # steps of a coordinate per thickness of the median Gaussian, at least
ROTATION_STEP = 8  # of 511, in which an entry of a quaternion reaches 1/√2
LIGHT_STEP = 2  # of 128, in which a coefficient reaches 1; `splats.rounded` has larger ones
LEAST_STEPS = 4096  # of a coordinate across 90 % of a scene that is far from the origin
MOST_CUT = 0.01  # share of Gaussians with a size that SPZ may lack


def write_spz(
    path: Path, parameters: dict[str, np.ndarray], degree: int, world: World = HERE
) -> np.ndarray:
    """Write raw parameters (`formats.gaussians.Gaussians.parameters`) as SPZ of version 3.

    Args:   degree: highest band to write; world: of the parameters; the file has its source's.
    Returns: the order of the file, i64 [N]: rows of the parameters.
    Raises: DataFailure where centres or sizes do not fit into 24 and 8 bits.
    Choices: Gaussians are in the order of a curve, so that neighbours in the file are neighbours in
      space. Of the 24 equivalent orders and signs of a Gaussian's axes, the one with the smallest
      rotation is written: its quaternions have less entropy. Bits without a visible effect are
      zero, for gzip. A distant Gaussian is drawn nearer, as in `packed.pack`.
    """
    from scipy.special import expit

    means, log_scales = drawn_near(
        world.outward(parameters["means"]), parameters["log_scales"] + np.log(world.scale)
    )
    bits = _fraction_bits(means, log_scales)
    order = along_a_curve(means)
    quats, log_scales = least_turned(parameters["quats"][order], log_scales[order])
    fixed = np.rint(means[order] * [1, -1, -1] * 2.0**bits).astype(np.int64)
    sh0, shN = (parameters[name][order].astype(np.float64) for name in ("sh0", "shN"))
    light = shN[:, : REST[degree]] * TURNED[: REST[degree], None]
    planes = (
        np.stack([fixed >> shift & 255 for shift in (0, 8, 16)], 2),
        255 * expit(parameters["logit_opacities"][order].astype(np.float64)),
        255 * (0.15 * sh0 + 0.5),
        16 * (log_scales + 10),
        to_smallest_three(quats * [1, 1, -1, -1]),
        LIGHT_STEP * np.rint(128 / LIGHT_STEP * light) + 128,
    )
    content = HEADER.pack(b"NGSP", 3, len(means), degree, bits, 0)
    content += b"".join(np.rint(plane).clip(0, 255).astype(np.uint8).tobytes() for plane in planes)
    path.write_bytes(gzip.compress(content, 9, mtime=0))
    return order


def _fraction_bits(means: np.ndarray, log_scales: np.ndarray) -> int:
    """Bits of a coordinate's fraction; errors of `write_spz`."""
    needed = np.ceil(np.log2(FINE) - np.median(log_scales.min(1)) / np.log(2)).clip(0, 23)
    fitting = np.floor(np.log2((2**23 - 1) / np.abs(means).max().clip(1)))
    low, high = np.quantile(means, (0.05, 0.95), axis=0)
    coarse = fitting < 0 or (fitting < needed and 2**fitting * (high - low).max() < LEAST_STEPS)
    largest = log_scales.max(1)
    if coarse or ((largest < -10) | (largest > 255 / 16 - 10)).mean() > MOST_CUT:
        raise DataFailure(
            "SPZ has sizes of 0.00005 to 380 units and centres of 24 bits, into which this scene "
            "does not fit; export it as .ply"
        )
    return int(min(needed, fitting))


def least_turned(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same Gaussians by other axes: unit quaternions [N, 4] (wxyz) of the smallest rotation,
    and the log-scales [N, 3] along its axes.
    """
    from scipy.spatial.transform import Rotation

    unit = quats.astype(np.float64)
    unit[np.linalg.norm(unit, axis=1) == 0] = [1, 0, 0, 0]  # as renderers have it
    turns = Rotation.create_group("O")
    real = unit @ (turns.as_quat(scalar_first=True) * [1, -1, -1, -1]).T  # of each turn undone
    nearest = np.abs(real).argmax(1)
    axes = np.abs(turns.as_matrix()).round()[nearest]
    turned = Rotation.from_quat(unit, scalar_first=True) * turns[nearest]
    return turned.as_quat(scalar_first=True), np.einsum("nij,ni->nj", axes, log_scales)


def to_smallest_three(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] (wxyz) as bytes [N, 4] for `_smallest_three`, by ROTATION_STEP."""
    xyzw, rows = quats[:, [1, 2, 3, 0]], np.arange(len(quats))
    place = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[rows, place] < 0, -1, 1)[:, None]
    steps = ROTATION_STEP * np.rint(np.abs(xyzw) * np.sqrt(2) * 511 / ROTATION_STEP)
    negative = (xyzw < 0) & (steps > 0)
    fields = steps.clip(0, 511).astype(np.uint32) | 512 * negative.astype(np.uint32)
    words = place.astype(np.uint32)
    for entry in range(4):
        words = np.where(place == entry, words, words << 10 | fields[:, entry])
    stored: np.ndarray = words.astype("<u4").view(np.uint8).reshape(-1, 4)
    return stored


def read_spz(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Raw parameters in the axes of PLY files, and the degree. Raises InputError with the path."""
    data = path.read_bytes()
    try:
        plain = data if data[:4] == b"NGSP" else zlib.decompressobj(31).decompress(data, LARGEST)
        magic, version, n, degree, bits, _ = HEADER.unpack_from(plain.ljust(HEADER.size, b"\0"))
        if (
            magic != b"NGSP"
            or degree not in REST
            or version not in ((4,) if plain is data else (2, 3))
        ):
            raise ValueError(f"{magic!r}, version {version}, degree {degree}")
        quat = 3 if version == 2 else 4
        widths = {"means": 9, "alphas": 1, "colors": 3, "scales": 3, "quats": quat}
        widths["sh"] = 3 * REST[degree]
        if n * sum(widths.values()) > LARGEST:
            raise ValueError(f"it has more than the {LARGEST >> 20} MiB that are read")
        sizes = [n * width for width in widths.values()]
        if version == 4:
            streams = _unpacked(plain, sizes)
        else:
            ends = np.cumsum(sizes) + HEADER.size
            streams = [plain[end - size : end] for end, size in zip(ends, sizes, strict=True)]
        planes = {
            name: np.frombuffer(stream, np.uint8).reshape(n, width)
            for (name, width), stream in zip(widths.items(), streams, strict=True)
        }
    except (ValueError, RuntimeError, struct.error, zlib.error) as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is cut or no SPZ of version 2 to 4 ({line}); {REMEDY}") from None
    coordinates = planes["means"].reshape(n, 3, 3).astype(np.int32)
    fixed = coordinates[..., 0] | coordinates[..., 1] << 8 | coordinates[..., 2] << 16
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed)
    quats = (_three_bytes if version == 2 else _smallest_three)(planes["quats"])
    return raw_parameters(
        fixed / 2.0**bits * [1, -1, -1],
        planes["scales"] / 16 - 10,
        quats * [1, 1, -1, -1],
        planes["alphas"][:, 0],
        (planes["colors"] / 255 - 0.5) / 0.15,
        (planes["sh"].reshape(n, REST[degree], 3).astype(np.float32) / 128 - 1)
        * TURNED[: REST[degree], None],
    ), degree


def _unpacked(data: bytes, sizes: list[int]) -> list[bytes]:
    """Streams of version 4, of these sizes. Raises ValueError, RuntimeError or struct.error."""
    *_, n_streams, table = HEADER_4.unpack_from(data)
    at, streams = table + n_streams * SIZES.size, []
    for k, size in enumerate(sizes):
        stream = bytearray(size)
        if size:
            packed, plain = SIZES.unpack_from(data, table + k * SIZES.size)
            if k >= n_streams or plain != size:
                raise ValueError(f"stream {k} has {plain} bytes, {size} are needed")
            Zstd().decode(data[at : at + packed], stream)
            at += packed
        streams.append(bytes(stream))
    return streams


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
