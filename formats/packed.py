"""Gaussians in 20 bytes each, for pages in a browser: quantised, in byte planes that compress well.

`stages/pages/scene/splats.js` reads what this module writes. Planes are u8 [..., N], one Gaussian a
column; numbers of more than one byte lie lowest byte first. A value is its integer times `step`
plus `low`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

BYTES = {"means": 9, "log_scales": 3, "quats": 4, "opacities": 1, "colors": 3}  # of a Gaussian
C0 = 0.28209479177387814  # of SH band 0, from coefficients to colours
# ln of the range of scales, relative to the longest axes of 5 % (thinner than a pixel) and of 95 %
# (flat) of the Gaussians
LEAST, MOST = -4.0, 12.0
# from the middle, in extents of 90 % of the centres: Gaussians beyond are drawn there, scaled down
# to the same apparent size
FARTHEST = 1000.0
COLORS = (-1.0, 3.0)  # of SH degree 0 in training's [0, 1]; values beyond are invisible


@dataclass
class Packed:
    """Arrays by name, and `low` and `step` of each quantised one, a number an axis or channel.

    means:      u8 [3, 3, N], axis and byte; `low` and `step` in the scene's frame and units.
    log_scales: u8 [3, N]; quats: u8 [4, N], of u32: the largest entry's place in the 2 upper bits,
      the others in order (wxyz, the largest positive) as 10 bits each over ±1/√2.
    opacities:  u8 [N] of [0, 1]; colors: u8 [3, N], of SH degree 0, 1 is white.
    sh1:        i8 [9, N], coefficients of band 1, coefficient-major; optional.
    features:   i8 [C, R], a dictionary, and meanings: u16 [N], each Gaussian's row of it; optional.
    """

    arrays: dict[str, np.ndarray]
    ranges: dict[str, dict[str, list[float]]] = field(default_factory=dict)


def pack(parameters: dict[str, np.ndarray], sh_degree: int = 0) -> Packed:
    """Quantise raw parameters (`Scene.parameters`). Raises ValueError on a degree over 1.

    Choices: 24 bits a coordinate, and FARTHEST, so that a stray Gaussian far off costs the others
      no visible precision; scales to about 2 %, at worst 4 %, clipped around the sizes of most;
      activated opacities, since logits would spend their bits where nothing changes.
    """
    if sh_degree not in (0, 1):
        raise ValueError(f"a page holds SH degree 0 or 1, not {sh_degree}")
    arrays: dict[str, np.ndarray] = {}
    ranges: dict[str, dict[str, list[float]]] = {}

    def levels(name: str, values: np.ndarray, top: int) -> np.ndarray:
        low, high = values.min(0), values.max(0)
        step = np.where(high > low, (high - low) / top, 1.0)
        ranges[name] = {"low": low.tolist(), "step": step.tolist()}
        integers: np.ndarray = np.round((values - low) / step).T
        return integers

    near, log_scales = drawn_near(parameters["means"], parameters["log_scales"])
    means = levels("means", near, (1 << 24) - 1).astype(np.uint32)
    arrays["means"] = np.stack([means >> shift & 255 for shift in (0, 8, 16)], 1).astype(np.uint8)
    bounds = np.quantile(log_scales.max(1), (0.05, 0.95)) + np.array([LEAST, MOST])
    arrays["log_scales"] = levels("log_scales", log_scales.clip(*bounds), 255).astype(np.uint8)
    words = smallest_three(parameters["quats"])
    arrays["quats"] = np.stack([words >> shift & 255 for shift in (0, 8, 16, 24)]).astype(np.uint8)
    opacities = 1 / (1 + np.exp(-parameters["logit_opacities"].astype(np.float64).clip(-700, 700)))
    arrays["opacities"] = np.round(255 * opacities).astype(np.uint8)
    colors = (parameters["sh0"][:, 0].astype(np.float64) * C0 + 0.5).clip(*COLORS)
    arrays["colors"] = levels("colors", colors, 255).astype(np.uint8)
    if sh_degree:
        arrays["sh1"], ranges["sh1"] = signed(parameters["shN"][:, :3].reshape(len(colors), 9))
    if "features" in parameters:
        dictionary, rows = np.unique(parameters["features"], axis=0, return_inverse=True)
        arrays["features"], ranges["features"] = signed(dictionary)
        arrays["meanings"] = rows.reshape(-1).astype(np.uint16)
    return Packed(arrays, ranges)


def drawn_near(means: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres [N, 3], f64, and log-scales [N, 3], those beyond FARTHEST drawn there."""
    low, middle, high = np.quantile(means.astype(np.float64), (0.05, 0.5, 0.95), axis=0)
    away = means - middle
    drawn = np.minimum(
        FARTHEST * ((high - low).max() or np.inf) / np.linalg.norm(away, axis=1).clip(1e-300), 1
    )
    return middle + drawn[:, None] * away, log_scales + np.log(drawn)[:, None]


def along_a_curve(means: np.ndarray) -> np.ndarray:
    """Order i64 [N] of centres [N, 3] along Morton's curve, with 16 bits an axis of their box."""
    low = means.min(0)
    cells = (65535 * (means - low) / max((means.max(0) - low).max(), 1e-300)).astype(">u2")
    bits = np.unpackbits(np.ascontiguousarray(cells).view(np.uint8).reshape(-1, 3, 2), axis=2)
    codes = np.zeros((len(means), 8), np.uint8)
    codes[:, 2:] = np.packbits(bits.transpose(0, 2, 1).reshape(len(means), 48), axis=1)
    return np.argsort(codes.view(">u8")[:, 0], kind="stable")


def unpack(packed: Packed) -> dict[str, np.ndarray]:
    """Parameters as for `pack`, float32, unit quaternions; logits ±20 for opacities of 0 and 1."""
    arrays = packed.arrays

    def values(name: str, integers: np.ndarray) -> np.ndarray:
        span = packed.ranges[name]
        dequantised: np.ndarray = integers.T * np.array(span["step"]) + np.array(
            span.get("low", 0.0)
        )
        return dequantised

    bytes_of = arrays["means"].astype(np.uint32)
    means = values("means", bytes_of[:, 0] | bytes_of[:, 1] << 8 | bytes_of[:, 2] << 16)
    opacities = arrays["opacities"] / 255
    with np.errstate(divide="ignore"):
        logits = np.log(opacities / (1 - opacities)).clip(-20, 20)
    parameters = {
        "means": means,
        "log_scales": values("log_scales", arrays["log_scales"]),
        "quats": from_smallest_three(arrays["quats"].astype(np.uint32)),
        "logit_opacities": logits,
        "sh0": (values("colors", arrays["colors"])[:, None] - 0.5) / C0,
        "shN": np.zeros((len(means), 15, 3)),
    }
    if "sh1" in arrays:
        parameters["shN"][:, :3] = values("sh1", arrays["sh1"]).reshape(-1, 3, 3)
    if "features" in arrays:
        parameters["features"] = values("features", arrays["features"])[arrays["meanings"]]
    return {name: value.astype(np.float32) for name, value in parameters.items()}


def raw_parameters(
    means: np.ndarray,
    log_scales: np.ndarray,
    quats: np.ndarray,
    alphas: np.ndarray,
    sh0: np.ndarray,
    sh: np.ndarray,
) -> dict[str, np.ndarray]:
    """Raw parameters from quantised ones; alphas: bytes [N]; sh0 [N, 3]; sh [N, K, 3]."""
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


def signed(rows: np.ndarray) -> tuple[np.ndarray, dict[str, list[float]]]:
    """Rows [N, C] as i8 [C, N], and the step of each channel, the same above and below zero."""
    step = np.abs(rows.astype(np.float64)).max(0, initial=0) / 127
    step = np.where(step > 0, step, 1.0)
    return np.round(rows / step).astype(np.int8).T, {"step": step.tolist()}


def smallest_three(quats: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] of any length as u32 [N]."""
    unit = quats.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True).clip(1e-300)  # of float32, of any length
    place = np.abs(unit).argmax(1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, place] < 0, -1, 1)[:, None]
    others = unit[rows[:, None], OTHERS[place]]
    steps = np.round((others * np.sqrt(0.5) + 0.5) * 1023).clip(0, 1023).astype(np.uint32)
    words: np.ndarray = (
        place.astype(np.uint32) << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    )
    return words


def from_smallest_three(planes: np.ndarray) -> np.ndarray:
    """Bytes u32 [4, N] to unit quaternions [N, 4]."""
    words = planes[0] | planes[1] << 8 | planes[2] << 16 | planes[3] << 24
    place = words >> 30
    others = (
        np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], 1) / 1023 - 0.5
    ) / np.sqrt(0.5)
    quats = np.empty((len(words), 4))
    rows = np.arange(len(words))
    quats[rows[:, None], OTHERS[place]] = others
    quats[rows, place] = np.sqrt((1 - (others**2).sum(1)).clip(0))
    unit: np.ndarray = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return unit


OTHERS = np.array(
    [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
)  # indices other than the largest entry's


def to_bytes(arrays: dict[str, np.ndarray]) -> tuple[bytes, dict[str, Any]]:
    """Arrays one after the other, at multiples of 4; by name the dtype, shape, offset of each."""
    blob, places = bytearray(), {}
    for name, array in arrays.items():
        blob += bytes(-len(blob) % 4)
        places[name] = {"dtype": array.dtype.name, "shape": list(array.shape), "offset": len(blob)}
        blob += np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
    return bytes(blob), places


def from_bytes(blob: bytes, places: dict[str, Any]) -> dict[str, np.ndarray]:
    """The arrays that `to_bytes` packed."""
    return {
        name: np.frombuffer(blob, at["dtype"], int(np.prod(at["shape"])), at["offset"]).reshape(
            at["shape"]
        )
        for name, at in places.items()
    }
