"""PlayCanvas' SOG, version 2: a zip of meta.json and lossless WebP images, a pixel a Gaussian."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import InputError
from chebsplat.formats.packed import OTHERS, along_a_curve, raw_parameters
from chebsplat.formats.ply import REST
from chebsplat.formats.spz import LARGEST, REMEDY, least_turned
from chebsplat.formats.world import HERE, World

LIGHT_STEP = 1 / 64  # of a coefficient, in the palette of light, at least
ROUNDS = 20  # of Lloyd's algorithm, for a codebook
DAMAGED = (ValueError, LookupError, TypeError, OSError, OverflowError)  # raised by foreign files
ACROSS = 64  # rows of the palette of light beside one another in its picture
MOST_LIGHTS = 65_536  # rows of the palette, which two bytes count


def write_sog(
    path: Path, parameters: dict[str, np.ndarray], degree: int, world: World = HERE
) -> np.ndarray:
    """Write raw parameters (`formats.gaussians.Gaussians.parameters`) as one .sog file.

    Args:   degree: highest band to write; world: of the parameters; the file has its source's.
    Returns: the order of the file, i64 [N]: rows of the parameters.
    Choices: order and axes of `spz.write_spz`. The palette of light has the distinct rows of all
      Gaussians, in the finest steps from LIGHT_STEP on that give at most MOST_LIGHTS: pruned
      Gaussians share one row.
    """
    from scipy.special import expit

    means = world.outward(parameters["means"]).astype(np.float64)
    order = along_a_curve(means)
    quats, log_scales = least_turned(
        parameters["quats"][order], parameters["log_scales"][order] + np.log(world.scale)
    )
    n, K = len(order), REST[degree]
    width = int(np.ceil(np.sqrt(n) / 4) * 4)
    files: dict[str, bytes] = {}

    def picture(name: str, values: np.ndarray, columns: int = width) -> str:
        pixels = np.zeros((-(-len(values) // columns) * columns, 4), np.uint8)
        pixels[:, 3] = 255
        pixels[: len(values), : values.shape[1]] = values
        stream = io.BytesIO()
        image = Image.fromarray(pixels.reshape(-1, columns, 4))
        image.save(stream, "WEBP", lossless=True, quality=80, method=4, exact=True)
        files[f"{name}.webp"] = stream.getvalue()
        return f"{name}.webp"

    bent = np.sign(means[order]) * np.log1p(np.abs(means[order]))
    low, high = bent.min(0), bent.max(0)
    fixed = np.rint(65535 * (bent - low) / np.where(high > low, high - low, 1)).astype(np.int64)
    scales, sizes = codebook(log_scales)
    colors, shades = codebook(parameters["sh0"][order, 0])
    alphas = np.rint(255 * expit(parameters["logit_opacities"][order, None].astype(np.float64)))
    place = np.abs(quats).argmax(1)
    unit = quats * np.where(quats[np.arange(n), place] < 0, -1, 1)[:, None]
    others = np.rint(255 * (unit[np.arange(n)[:, None], OTHERS[place]] * np.sqrt(0.5) + 0.5))
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "chebsplat"}, "count": n}
    meta["means"] = {
        "mins": low.tolist(),
        "maxs": high.tolist(),
        "files": [picture("means_l", fixed & 255), picture("means_u", fixed >> 8)],
    }
    meta["scales"] = {"codebook": sizes, "files": [picture("scales", scales)]}
    quat_bytes = np.concatenate([others, 252 + place[:, None]], 1)
    meta["quats"] = {"files": [picture("quats", quat_bytes)]}
    appearance = np.concatenate([colors, alphas], 1)
    meta["sh0"] = {"codebook": shades, "files": [picture("sh0", appearance)]}
    if K:
        palette, rows = lights(parameters["shN"][order, :K])
        entries, levels = codebook(palette)
        padded = np.zeros((-(-len(palette) // ACROSS) * ACROSS, K, 3), np.uint8)
        padded[: len(palette)] = entries
        names = [
            picture("shN_centroids", padded.reshape(-1, 3), ACROSS * K),
            picture("shN_labels", np.stack([rows & 255, rows >> 8], 1)),
        ]
        meta["shN"] = {"count": len(palette), "bands": degree, "codebook": levels, "files": names}
    with zipfile.ZipFile(path, "w") as whole:
        for name, content in {"meta.json": json.dumps(meta).encode(), **files}.items():
            whole.writestr(zipfile.ZipInfo(name), content)
    return order


def lights(shN: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A palette [P, K, 3] of the coefficients [N, K, 3], and each Gaussian's row of it, [N]."""
    step = LIGHT_STEP
    while True:
        steps = np.rint(shN.reshape(len(shN), -1) / step).astype(np.int16)
        palette, rows = np.unique(steps, axis=0, return_inverse=True)
        if len(palette) <= MOST_LIGHTS:
            return step * palette.reshape(len(palette), -1, 3), rows.reshape(-1)
        step *= 2


def codebook(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Nearest of 256 levels to each of values [...], and the levels, by Lloyd from quantiles."""
    flat = np.sort(values.ravel().astype(np.float64))
    levels = np.quantile(flat, np.linspace(0, 1, 256))
    for _ in range(ROUNDS):
        ends = np.searchsorted(flat, (levels[1:] + levels[:-1]) / 2)
        bounds = np.concatenate([[0], ends, [len(flat)]])
        sums = np.diff(np.concatenate([[0], np.cumsum(flat)])[bounds])
        counts = np.diff(bounds)
        levels = np.where(counts > 0, sums / counts.clip(1), levels)
    return np.searchsorted((levels[1:] + levels[:-1]) / 2, values), levels.tolist()


def read_sog(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Raw parameters in the axes of PLY files, and the degree. Raises InputError with the path."""
    try:
        with zipfile.ZipFile(path) as whole:
            if sum(entry.file_size for entry in whole.infolist()) > LARGEST:
                raise ValueError(f"it has more than the {LARGEST >> 20} MiB that are read")
            meta = json.loads(whole.read("meta.json"))
            if meta["version"] != 2:
                raise ValueError(f"version {meta['version']}")
            if meta["count"] < 0:
                raise ValueError(f"{meta['count']} Gaussians")

            def picture(of: str, which: int = 0) -> np.ndarray:
                content = whole.read(meta[of]["files"][which])
                return np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))

            def pixels(of: str, which: int = 0) -> np.ndarray:
                values = picture(of, which).reshape(-1, 4)[: meta["count"]]
                if len(values) < meta["count"]:
                    raise ValueError(f"{of} has {len(values)} pixels for {meta['count']} Gaussians")
                whole_numbers: np.ndarray = values.astype(np.int64)
                return whole_numbers

            def values(of: str, entries: np.ndarray) -> np.ndarray:
                levels = np.array(meta[of]["codebook"], np.float64)
                if levels.ndim != 1:
                    raise ValueError(f"{of} has no codebook of numbers")
                return np.asarray(levels[entries])

            fixed = pixels("means")[:, :3] | pixels("means", 1)[:, :3] << 8
            low, high = (np.array(meta["means"][side]) for side in ("mins", "maxs"))
            bent = low + fixed / 65535 * (high - low)
            stored, shades = pixels("quats"), pixels("sh0")
            light, degree = np.zeros((len(fixed), 0, 3)), 0
            if "shN" in meta:
                degree = meta["shN"]["bands"]
                palette = picture("shN")[..., :3].reshape(-1, REST[degree], 3)
                labels = pixels("shN", 1)
                light = values("shN", palette)[labels[:, 0] | labels[:, 1] << 8]
            log_scales, colors = values("scales", pixels("scales")[:, :3]), values("sh0", shades)
    except (*DAMAGED, zipfile.BadZipFile, Image.DecompressionBombError) as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is cut or no SOG of version 2 ({line}); {REMEDY}") from None
    place, rows = (stored[:, 3] - 252).clip(0, 3), np.arange(len(stored))
    quats = np.zeros((len(stored), 4))
    others = (stored[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    quats[rows[:, None], OTHERS[place]] = others
    quats[rows, place] = np.sqrt((1 - (others**2).sum(1)).clip(0))
    means = np.sign(bent) * np.expm1(np.abs(bent))
    return raw_parameters(means, log_scales, quats, shades[:, 3], colors[:, :3], light), degree
