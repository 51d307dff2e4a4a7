"""Rooms to train on: the presets, and rooms furnished at random, with other materials and light;
photographed anywhere; rendered once, and cropped at random.

Choices: a third each of the presets as they are seen by users, the presets with other materials,
  and shuffled rooms; otherwise the network learns where things stand and what colour they have
  instead of what they look like.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

import chebsplat.stages.sources.generated as photographer
from chebsplat.formats.files import atomic_path
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.sources.generated import photograph
from chebsplat.synthetic import layout
from chebsplat.synthetic.layout import TRAINING
from chebsplat.synthetic.rays import RayCaster, intrinsics, look_at
from chebsplat.synthetic.shuffled import build, jitter
from chebsplat.teachers.network import STRIDE

Generator = np.random.Generator
WIDTH, HEIGHT = 320, 240
# taken in turn by seed
KINDS = ("office", "room", "jittered office", "jittered room", "shuffled", "shuffled")


def training_views(seed: int, n_views: int) -> tuple[np.ndarray, np.ndarray]:
    """Images u8 [V, H, W, 3] and labels i8 [V, H, W] of one training room.

    Raises: ValueError if the seed is not one of TRAINING.
    """
    if seed not in TRAINING:
        raise ValueError(f"seed {seed} is not one for training: {TRAINING}")
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng([seed, 2])
    room = build(kind.split()[-1], seed)
    if kind not in ("office", "room"):
        jitter(room, rng)
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    views = []
    for _ in range(n_views):
        K = intrinsics(WIDTH, HEIGHT, rng.uniform(55, 90))
        views.append(photograph(room, caster, K, viewpoint(room.size, rng), WIDTH, HEIGHT))
    return np.stack([view[0] for view in views]), np.stack([view[2] for view in views]).astype(
        np.int8
    )


def generator_digest() -> str:
    """Of the code that rooms are made by: a folder of rendered rooms is known by it."""
    sources = sorted(Path(layout.__file__).parent.glob("*.py"))
    texts = [path.read_bytes() for path in (*sources, Path(photographer.__file__), Path(__file__))]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:12]


def viewpoint(size: tuple[float, float, float], rng: Generator) -> np.ndarray:
    """A pose [4, 4] of a person a metre or more from the walls, mostly looking across the room."""
    w, d, _ = size
    eye = np.array([rng.uniform(1.0, w - 1.0), rng.uniform(1.0, d - 1.0), rng.uniform(1.25, 1.85)])
    across = np.arctan2(d / 2 - eye[1], w / 2 - eye[0])
    yaw = rng.uniform(-np.pi, np.pi) if rng.random() < 0.4 else across + rng.normal(0, 0.7)
    pitch = np.deg2rad(rng.uniform(-35, 12))
    return look_at(
        eye,
        eye + np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]),
    )


def rendered(
    folder: Path, seeds: range, n_views: int, workers: int
) -> tuple[np.ndarray, np.ndarray]:
    """Images u8 [N, H, W, 3] and labels i8 [N, H, W] of the rooms of `seeds`, from the folder where
    they are there.

    Choices: a folder of its own for each version of the code that draws rooms, so that none is
      stale.
    """
    place = folder / f"{generator_digest()}-{n_views}"
    place.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not (place / f"{seed}.npz").is_file()]
    with ProcessPoolExecutor(workers) as pool:
        jobs = [pool.submit(partial(_render, place, seed, n_views)) for seed in missing]
        for job, _ in Progress().track(as_completed(jobs), len(jobs), "rooms"):
            job.result()
    images, labels = zip(*(_load(place / f"{seed}.npz") for seed in seeds), strict=True)
    return np.concatenate(images), np.concatenate(labels)


def _render(place: Path, seed: int, n_views: int) -> None:
    images, labels = training_views(seed, n_views)
    with atomic_path(place / f"{seed}.npz") as temporary:
        np.savez(temporary, images=images, labels=labels)


def _load(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with np.load(path) as stored:
        return stored["images"], stored["labels"]


def crops(
    images: Tensor, labels: Tensor, height: int, width: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Crops of u8 images [B, H, W, 3], and labels at the network's resolution.

    Returns: images [B, 3, height, width] in [0, 1]; labels i64 [B, height/2, width/2] of i8 [B, H,
      W].
    Choices: labels are those of the nearest pixel to the centre of a cell; outside the view they
      are -1. Between 0.74 and 1.35 times the scale, up to 5° of turn, one in two mirrored.
    """
    n, full_height, full_width = labels.shape
    scale = torch.exp(_uniform(n, generator, -0.3, 0.3))  # source pixels by pixel of the crop
    aspect = torch.exp(_uniform(n, generator, -0.12, 0.12))
    turn = torch.deg2rad(_uniform(n, generator, -5, 5))
    mirror = torch.where(_uniform(n, generator) < 0.5, -1.0, 1.0)
    half_x, half_y = scale * aspect * width / full_width, scale / aspect * height / full_height
    x = (1 - half_x).clip(0.15) * _uniform(n, generator, -1, 1)
    y = (1 - half_y).clip(0.15) * _uniform(n, generator, -1, 1)
    c, s, ratio = turn.cos(), turn.sin(), full_height / full_width
    rows = [torch.stack([mirror * half_x * c, -half_y * s * ratio, x], 1),
            torch.stack([mirror * half_x * s / ratio, half_y * c, y], 1)]  # fmt: skip
    theta = torch.stack(rows, 1)
    grid = F.affine_grid(theta, [n, 1, height, width], align_corners=False)
    coarse = F.affine_grid(theta, [n, 1, height // STRIDE, width // STRIDE], align_corners=False)
    source = images.permute(0, 3, 1, 2).float() / 255
    image = F.grid_sample(source, grid, padding_mode="reflection", align_corners=False)
    label = F.grid_sample(labels[:, None].float() + 1, coarse, mode="nearest", align_corners=False)
    return image, label[:, 0].long() - 1


def recolored(images: Tensor, generator: torch.Generator) -> Tensor:
    """Images [B, 3, H, W] in [0, 1] in other light and by another camera; four in ten unchanged."""
    n, untouched = len(images), images

    def draw_mask(share: float) -> Tensor:
        return (_uniform(n, generator) < share)[:, None, None, None]

    def number(low: float, high: float) -> Tensor:
        return _uniform(n, generator, low, high)[:, None, None, None]

    mix = torch.eye(3) + 0.1 * torch.randn(n, 3, 3, generator=generator)
    order = torch.stack([torch.randperm(3, generator=generator) for _ in range(n)])
    mix = torch.where(draw_mask(0.08)[:, 0], torch.eye(3)[order], mix)
    mix = torch.where(draw_mask(0.05)[:, 0], torch.full((3, 3), 1 / 3), mix)
    images = torch.where(draw_mask(0.8), torch.einsum("bij,bjhw->bihw", mix, images), images)
    images = images * torch.exp(0.25 * torch.randn(n, 1, 1, 1, generator=generator))
    images = images * torch.exp(0.1 * torch.randn(n, 3, 1, 1, generator=generator)) + number(
        -0.08, 0.08
    )
    images = images.clip(1e-4, 1) ** torch.exp(0.3 * torch.randn(n, 1, 1, 1, generator=generator))
    smooth = F.avg_pool2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), 3, 1)
    images = torch.where(draw_mask(0.5), images + number(-0.6, 1) * (smooth - images), images)
    sigma = torch.where(draw_mask(0.5), number(0, 0.05), torch.zeros(()))
    noisy = (images + sigma * torch.randn(images.shape, generator=generator)).clip(0, 1)
    return torch.where(draw_mask(0.4), untouched, noisy)


def _uniform(n: int, generator: torch.Generator, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(n, generator=generator)
