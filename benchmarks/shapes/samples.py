"""Regions of Gaussians on simple shapes, with noise, ghosts and a random pose.

Every shape fills about the unit ball and carries Gaussians of the same sizes: only places and orientations tell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Condition(NamedTuple):
    n: int = 64
    noise: float = 0.02  # of the centres, standard deviation, radii of the region
    frame_noise: float = 0.05  # of the orientations, standard deviation, radians
    ghosts: float = 0.0  # share of Gaussians that belong to nothing


class Regions(NamedTuple):
    """M regions of n Gaussians; labels index `SHAPES`."""

    means: np.ndarray  # [M, n, 3] f64
    scales: np.ndarray  # [M, n, 3]; the last axis is the normal's
    rotmats: np.ndarray  # [M, n, 3, 3]
    labels: np.ndarray  # [M] i64


SHAPES = ("plane", "edge", "corner", "cylinder", "sphere", "rod", "wave", "saddle")


def sample(condition: Condition, n_each: int, rng: np.random.Generator) -> Regions:
    """`n_each` regions of every shape, each of its own size, place, pose and parameters."""
    labels = np.repeat(np.arange(len(SHAPES)), n_each)
    regions = [_region(SHAPES[label], condition, rng) for label in labels]
    means, scales, rotmats = (np.stack(v) for v in zip(*regions, strict=True))
    return Regions(means, scales, rotmats, labels)


def mixed(n_each: int, rng: np.random.Generator) -> Regions:
    """As `sample`, but noise .02 to .1, frame noise .05 to .3 and up to 10 % ghosts, drawn `n_each` times."""
    parts = [
        sample(Condition(64, rng.uniform(0.02, 0.1), rng.uniform(0.05, 0.3), rng.uniform(0, 0.1)), 1, rng)
        for _ in range(n_each)
    ]
    return Regions(*(np.concatenate(v) for v in zip(*parts, strict=True)))


def surface(shape: str, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """n points [n, 3] on a shape and their unit normals [n, 3]."""
    u, v = _disc(n, rng).T
    zero, one = np.zeros(n), np.ones(n)
    if shape == "plane":
        return np.stack([u, v, zero], 1), np.stack([zero, zero, one], 1)
    if shape == "edge":
        return _folded(u - rng.uniform(-0.25, 0.25), v, rng.uniform(60, 120))
    if shape == "corner":
        face, inside = rng.integers(0, 3, n), np.abs(np.stack([u, v], 1))
        points = np.zeros((n, 3))
        points[np.arange(n), (face + 1) % 3], points[np.arange(n), (face + 2) % 3] = inside.T
        return points, np.eye(3)[face]
    if shape in ("cylinder", "rod"):
        radius, arc = (rng.uniform(0.45, 0.8), 0.5 * np.pi) if shape == "cylinder" else (rng.uniform(0.06, 0.14), np.pi)
        angle, along = rng.uniform(-arc, arc, n), rng.uniform(-1, 1, n)
        normals = np.stack([np.cos(angle), np.sin(angle), zero], 1)
        return radius * normals + along[:, None] * [0, 0, 1], normals
    if shape == "sphere":
        height, angle = rng.uniform(rng.uniform(-0.2, 0.4), 1, n), rng.uniform(-np.pi, np.pi, n)
        ring = np.sqrt(1 - height**2)
        normals = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], 1)
        return rng.uniform(0.6, 1.0) * normals, normals
    if shape == "wave":
        size, rate, phase = rng.uniform(0.12, 0.25), rng.uniform(4, 7), rng.uniform(0, 2 * np.pi)
        return _graph(u, v, size * np.sin(rate * u + phase), size * rate * np.cos(rate * u + phase), zero)
    if shape == "saddle":
        bend = rng.uniform(0.3, 0.6)
        return _graph(u, v, bend * (u * u - v * v), 2 * bend * u, -2 * bend * v)
    raise ValueError(f"shape {shape!r} is none of {SHAPES}")


def _disc(n: int, rng: np.random.Generator) -> np.ndarray:
    radius, angle = np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)


def _graph(u: np.ndarray, v: np.ndarray, height: np.ndarray, by_u: np.ndarray, by_v: np.ndarray) -> tuple:
    normals = np.stack([-by_u, -by_v, np.ones_like(u)], 1)
    return np.stack([u, v, height], 1), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _folded(u: np.ndarray, v: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The half u > 0 of a plane, turned about v until the two enclose an angle."""
    turn = np.pi - np.radians(degrees)
    bent = u > 0
    points = np.stack([np.where(bent, u * np.cos(turn), u), v, np.where(bent, u * np.sin(turn), 0)], 1)
    normals = np.stack([np.where(bent, -np.sin(turn), 0), 0 * v, np.where(bent, np.cos(turn), 1)], 1)
    return points, normals


def _region(shape: str, condition: Condition, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = condition.n
    means, normals = surface(shape, n, rng)
    means = means + condition.noise * rng.normal(size=(n, 3))
    normals = normals + condition.frame_noise * rng.normal(size=(n, 3))
    n_ghosts = round(condition.ghosts * n)
    ghosts = rng.permutation(n)[:n_ghosts]
    means[ghosts], normals[ghosts] = rng.uniform(-1, 1, (n_ghosts, 3)), rng.normal(size=(n_ghosts, 3))
    spacing = 1.8 / np.sqrt(n)
    scales = spacing * np.stack([rng.uniform(0.5, 1, n), rng.uniform(0.5, 1, n), rng.uniform(0.03, 0.12, n)], 1)
    rotmats = frames(normals, rng)
    pose, size = frames(rng.normal(size=(1, 3)), rng)[0], 10.0 ** rng.uniform(-2, 2)
    place = 10 * rng.normal(size=3)
    return size * (means @ pose.T + place), size * scales, pose @ rotmats


def frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotations [n, 3, 3] whose last column is the normal [n, 3], turned about it at random."""
    third = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    helper = rng.normal(size=third.shape)
    first = helper - (helper * third).sum(1, keepdims=True) * third
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], -1)
