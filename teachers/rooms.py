"""Rooms to train on: the presets, and rooms furnished at random, with other materials and light; photographed anywhere.

Choices: a third each of the presets as they are seen by users, the presets with other materials, and shuffled rooms;
  otherwise the network learns where things stand and what colour they have instead of what they look like.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

import chebsplat.stages.sources.generated as photographer
from chebsplat.stages.sources.generated import photograph
from chebsplat.synthetic import layout
from chebsplat.synthetic.layout import TRAINING
from chebsplat.synthetic.rays import RayCaster, intrinsics, look_at
from chebsplat.synthetic.shuffled import build, jitter

Generator = np.random.Generator
WIDTH, HEIGHT = 320, 240
KINDS = ("office", "room", "jittered office", "jittered room", "shuffled", "shuffled")  # taken in turn by seed


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
    return np.stack([view[0] for view in views]), np.stack([view[2] for view in views]).astype(np.int8)


def generator_digest() -> str:
    """Of the code that rooms are made by: a folder of rendered rooms is known by it."""
    sources = sorted(Path(layout.__file__).parent.glob("*.py"))
    texts = [path.read_bytes() for path in (*sources, Path(photographer.__file__), Path(__file__))]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:12]


def viewpoint(size: tuple[float, float, float], rng: Generator) -> np.ndarray:
    """A pose [4, 4] of somebody standing a metre or more from the walls, who looks more often across the room."""
    w, d, _ = size
    eye = np.array([rng.uniform(1.0, w - 1.0), rng.uniform(1.0, d - 1.0), rng.uniform(1.25, 1.85)])
    across = np.arctan2(d / 2 - eye[1], w / 2 - eye[0])
    yaw = rng.uniform(-np.pi, np.pi) if rng.random() < 0.4 else across + rng.normal(0, 0.7)
    pitch = np.deg2rad(rng.uniform(-35, 12))
    return look_at(eye, eye + np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]))
