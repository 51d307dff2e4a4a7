"""Solid textures: colour of a point from its texture coordinates, smooth at the scale of a pixel.

Its shade: ambient light, two panels with soft shadows, and a highlight that moves with the eye.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

# points of a panel that light is taken from
SAMPLES = ((-0.7, -0.6), (0.6, -0.7), (0.7, 0.6), (-0.6, 0.7))


@dataclass(frozen=True)
class Material:
    """Pattern between two linear colours; `scale` is the pattern's period in metres, `gloss` the
    height of the highlight and `shininess` its exponent; `seed` decorrelates noise.
    """

    pattern: str
    first: tuple[float, float, float]
    second: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 0.2
    gloss: float = 0.0
    shininess: float = 30.0
    seed: int = 0


def noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Value noise [N] in [0, 1] of period 1 at points [N, 3], twice continuously differentiable."""
    cell = np.floor(points)
    f = (points - cell).astype(np.float32)
    f = f * f * f * (f * (f * 6 - 15) + 10)
    i = cell.astype(np.int64).astype(np.uint32)
    total = np.zeros(len(points), np.float32)
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (
            (f[:, 0] if x else 1 - f[:, 0])
            * (f[:, 1] if y else 1 - f[:, 1])
            * (f[:, 2] if z else 1 - f[:, 2])
        )
        total += weight * _hashed(
            i[:, 0] + np.uint32(x), i[:, 1] + np.uint32(y), i[:, 2] + np.uint32(z), seed
        )
    return total


def _hashed(x: np.ndarray, y: np.ndarray, z: np.ndarray, seed: int) -> np.ndarray:
    h: Any = x * np.uint32(0x8DA6B343) + y * np.uint32(0xD8163841) + z * np.uint32(0xCB1AB31F)
    h = h + np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    values: np.ndarray = (h ^ (h >> np.uint32(15))).astype(np.float32) * np.float32(2.0**-32)
    return values


def _edge(x: np.ndarray, softness: float) -> np.ndarray:
    """Square wave of period 1 in [0, 1] with soft flanks."""
    return np.clip(0.5 + np.sin(2 * np.pi * x) / (2 * softness), 0, 1)


def _wood(p: np.ndarray, m: Material) -> np.ndarray:
    stretched = p / m.scale * (0.25, 1.0, 1.0)
    return 0.5 + 0.5 * np.sin(
        2 * np.pi * (stretched[:, 1] + stretched[:, 2] + 1.6 * noise(stretched, m.seed))
    )


def _planks(p: np.ndarray, m: Material) -> np.ndarray:
    row = np.floor(p[:, 1] / m.scale)
    board = np.floor(p[:, 0] / (6 * m.scale) + 0.37 * row)
    tint = noise(np.stack([row * 3.7, board * 5.3, np.zeros_like(row)], 1), m.seed)
    grain = noise(p / m.scale * (0.4, 3.0, 3.0) + row[:, None] * 7.1, m.seed + 1)
    return np.clip(0.65 * tint + 0.35 * grain, 0, 1)


def _tiles(p: np.ndarray, m: Material) -> np.ndarray:
    gap = np.minimum(np.abs((p[:, :2] / m.scale) % 1 - 0.5).max(1), 1)
    shade: np.ndarray = np.clip((gap - 0.44) / 0.05, 0, 1)
    return shade


def _cloud(p: np.ndarray, m: Material) -> np.ndarray:
    return np.clip(
        0.7 * noise(p / m.scale, m.seed) + 0.3 * noise(2.3 * p / m.scale, m.seed + 1), 0, 1
    )


def _stripes(p: np.ndarray, m: Material) -> np.ndarray:
    return _edge(p[:, 0] / m.scale, 0.4)


def _check(p: np.ndarray, m: Material) -> np.ndarray:
    a, b = _edge(p[:, 0] / m.scale, 0.4), _edge(p[:, 1] / m.scale, 0.4)
    shade: np.ndarray = a + b - 2 * a * b
    return shade


def _rings(p: np.ndarray, m: Material) -> np.ndarray:
    return _edge(np.linalg.norm(p[:, :2], axis=1) / m.scale, 0.5)


def _dots(p: np.ndarray, m: Material) -> np.ndarray:
    inside = np.linalg.norm((p / m.scale) % 1 - 0.5, axis=1)
    shade: np.ndarray = np.clip((0.42 - inside) / 0.12, 0, 1)
    return shade


def _painting(p: np.ndarray, m: Material) -> np.ndarray:
    warped = p / m.scale + 0.8 * noise(p / m.scale, m.seed)[:, None]
    return _edge(1.5 * noise(warped, m.seed + 1) + 0.5 * noise(2 * warped, m.seed + 2), 0.5)


PATTERNS = {
    "wood": _wood, "planks": _planks, "tiles": _tiles, "cloud": _cloud,
    "stripes": _stripes, "check": _check, "rings": _rings, "dots": _dots, "painting": _painting,
}  # fmt: skip


def colors(points: np.ndarray, materials: np.ndarray, table: list[Material]) -> np.ndarray:
    """Linear colour [N, 3] of texture coordinates [N, 3] (metres) under material indices [N]."""
    out = np.zeros((len(points), 3), np.float32)
    for index in np.unique(materials):
        mask, material = materials == index, table[index]
        if material.pattern == "plain":
            out[mask] = material.first
            continue
        mix = PATTERNS[material.pattern](points[mask], material).astype(np.float32)[:, None]
        value = mix * np.float32(material.first) + (1 - mix) * np.float32(material.second)
        if material.pattern == "painting":
            hue = noise(points[mask] / (0.7 * material.scale), material.seed + 3)[:, None]
            value = 0.6 * value + 0.4 * hue * np.float32(material.first[::-1])
        out[mask] = value
    return out


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Row by row a · b, [N, 1]; several times faster on rows of three than a sum over the axis."""
    products: np.ndarray = np.einsum("ni,ni->n", a, b)[:, None]
    return products


def shade(
    points: np.ndarray,
    normals: np.ndarray,
    to_eye: np.ndarray,
    albedo: np.ndarray,
    gloss: np.ndarray,
    shininess: np.ndarray,
    lights: np.ndarray,
    is_blocked: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Linear light [N, 3] that leaves surface points towards the eye.

    Args:
      points, normals, to_eye: [N, 3], the latter two unit and on one side; albedo [N, 3]; gloss,
        shininess [N].
      lights:     [L, 2, 3] centres and half extents of ceiling panels, metres.
      is_blocked: shadow test of segments, (origins [N, 3], offsets [N, 3]) -> bool [N].
    """
    ambient = (0.40 + 0.10 * normals[:, 2:]) * np.array((1.0, 0.99, 0.97), np.float32)
    diffuse, highlight = (
        np.zeros((len(points), 1), np.float32),
        np.zeros((len(points), 1), np.float32),
    )
    start = points + 2e-3 * normals
    for centre, half in lights:
        for u, v in SAMPLES:
            offset = (centre + half * (u, v, 0) - start).astype(np.float32)
            distance = np.sqrt(dot(offset, offset))
            direction = offset / distance
            facing = np.maximum(dot(normals, direction), 0)
            falloff = np.maximum(-direction[:, 2:] * -1, 0) / (0.6 + distance**2)
            lit = ~is_blocked(start, offset * np.float32(0.995))[:, None]
            diffuse += lit * facing * falloff
            middle = direction + to_eye
            middle /= np.sqrt(dot(middle, middle)).clip(1e-6)
            highlight += (
                lit * (facing > 0) * np.maximum(dot(normals, middle), 0) ** shininess[:, None]
            )
    n = len(lights) * len(SAMPLES)
    return albedo * (ambient + 5.2 / len(SAMPLES) * 0.5 * diffuse) + gloss[:, None] * highlight / n


def tone_map(light: np.ndarray) -> np.ndarray:
    """Linear light to sRGB u8, the brightest parts rolled off."""
    exposed = 0.95 * light
    rolled = np.where(exposed < 0.7, exposed, 0.7 + 0.3 * (1 - np.exp(-(exposed - 0.7) / 0.3)))
    encoded = np.where(
        rolled < 0.0031308, 12.92 * rolled, 1.055 * np.maximum(rolled, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.round(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
