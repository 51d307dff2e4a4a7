"""Rendered captures through lenses that bend, with exact truth, for `unposed`.

Six rooms that nothing was chosen on, each as two lenses show it: four generated, and the two of the
modelled house where the test data is there (CHEBSPLAT_TEST_DATA). A folder is what `unposed` takes:
images/, and truth.json with each photo's camera-to-world matrix in metres. Photos carry no EXIF,
and have noise. A folder that exists is refused.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from benchmarks import shared
from chebsplat.stages.sources.generated import photograph
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from chebsplat.synthetic.shuffled import build

ROOMS = ("office", 31_001), ("room", 31_002), ("shuffled", 31_003), ("shuffled", 31_004)  # and seed
HOUSE = "house_kitchen", "house_living"
WIDTH, HEIGHT, FOV = 1152, 864, 84.0  # of a generated room; degrees across
NOISE = 2.0  # standard deviation, of 255


class Lens(NamedTuple):
    """x_d = x (1 + k₁ r² + k₂ r⁴); `part` of the picture's width and height that is shown."""

    k1: float
    k2: float
    part: float

    def bend(self, points: np.ndarray) -> np.ndarray:
        """Distorted normalised points [..., 2] of pinhole ones."""
        r2 = (points**2).sum(-1, keepdims=True)
        return np.asarray(points * (1 + self.k1 * r2 + self.k2 * r2**2))

    def straighten(self, points: np.ndarray) -> np.ndarray:
        """Inverse of `bend`, by fixed-point steps until nothing moves by 1e-9."""
        straight = points
        for _ in range(200):
            r2 = (straight**2).sum(-1, keepdims=True)
            better = points / (1 + self.k1 * r2 + self.k2 * r2**2)
            if np.abs(better - straight).max() < 1e-9:
                return np.asarray(better)
            straight = better
        raise ValueError(f"{self} cannot be undone where the picture shows it")


LENSES = {
    "action": Lens(-0.25, 0.06, 1.0),
    "phone": Lens(0.06, -0.04, 0.9),
    "zoom": Lens(-0.1, 0.0, 0.6),
}
PAIRS = ("action", "phone"), ("phone", "zoom"), ("zoom", "action")  # lenses of a room, by turns


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("lenses", __doc__)
    parser.add_argument("--views", type=int, default=30, help="photos of each capture")
    options = parser.parse_args(arguments)
    for number, (name, K, views) in enumerate(rooms(options.views)):
        lenses = PAIRS[number % len(PAIRS)]
        folders = [options.out / f"{name}-{lens}" for lens in lenses]
        if there := [folder for folder in folders if folder.exists()]:
            parser.error(f"{there[0]} exists; remove it, or choose another --out")
        truth = {}
        for k, (image, pose) in enumerate(views):
            truth[f"photo_{k:03d}"] = pose.tolist()
            for lens, folder in zip(lenses, folders, strict=True):
                (folder / "images").mkdir(parents=True, exist_ok=True)
                rng = np.random.default_rng([number, k])
                photo = through(image.astype(np.float64), K, LENSES[lens]) + rng.normal(
                    0, NOISE, image.shape
                )
                Image.fromarray(np.round(photo).clip(0, 255).astype(np.uint8)).save(
                    folder / "images" / f"photo_{k:03d}.jpg", quality=92
                )
        for folder in folders:
            (folder / "truth.json").write_text(json.dumps(truth))
            print(folder, flush=True)
    return 0


def rooms(
    n_views: int,
) -> Iterator[tuple[str, np.ndarray, Iterator[tuple[np.ndarray, np.ndarray]]]]:
    """Name, K [3, 3], and views of each room: image u8 [H, W, 3], world from camera [4, 4]."""
    for preset, seed in ROOMS:
        yield f"{preset}{seed}", intrinsics(WIDTH, HEIGHT, FOV), generated(preset, seed, n_views)
    data = Path(os.environ.get("CHEBSPLAT_TEST_DATA") or "../shared/data")
    for name in HOUSE:
        if not (scene := data / name / "scene.json").exists():
            print(f"{name} is left out: {scene} is not there (CHEBSPLAT_TEST_DATA)")
            continue
        document = json.loads(scene.read_text())
        across, down, x, y = (document[key] for key in ("fl_x", "fl_y", "cx", "cy"))
        K = np.array([[across, 0, x], [0, down, y], [0, 0, 1.0]])
        yield name, K, modelled(scene.parent / "images", document["frames"], n_views)


def generated(preset: str, seed: int, n_views: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Views of a generated room, as `rooms` has them."""
    room = build(preset, seed)
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    K = intrinsics(WIDTH, HEIGHT, FOV)
    for pose in walk(room.size, n_views, seed):
        yield photograph(room, caster, K, pose, WIDTH, HEIGHT)[0], np.linalg.inv(pose)


def modelled(
    images: Path, frames: list[dict[str, Any]], n_views: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Views of the house, as `rooms` has them; twice as many, since they are smaller."""
    for frame in frames[:: max(len(frames) // (2 * n_views), 1)]:
        with Image.open(images / frame["file"]) as image:
            yield np.asarray(image.convert("RGB")), np.array(frame["c2w"])


def camera(K: np.ndarray, lens: Lens, width: int, height: int) -> np.ndarray:
    """K [3, 3] of the photo, as large as the pinhole's picture, of which it shows as much as leaves
    no corner empty.
    """
    border = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)])
    half = np.array([width, height]) / 2 * lens.part
    bent = np.abs(lens.bend(border * half / K[0, 0]))
    reach = np.array([bent[border[:, k] != 0, k].min() for k in (0, 1)])
    focal = (np.array([width, height]) / 2 / reach).max()
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def through(image: np.ndarray, K: np.ndarray, lens: Lens) -> np.ndarray:
    """A pinhole's image [H, W, 3] as the lens shows it, f64 of the same size; cubic splines."""
    height, width = image.shape[:2]
    bent = camera(K, lens, width, height)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5
    points = lens.straighten((pixels - bent[:2, 2]) / bent[0, 0])
    at = (points * K[0, 0] + K[:2, 2] - 0.5)[..., ::-1].transpose(2, 0, 1)
    return np.stack(
        [map_coordinates(of, at, mode="nearest") for of in image.transpose(2, 0, 1)], -1
    )
