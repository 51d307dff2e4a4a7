"""Points on the surface that views show, for scenes without measured depth: fused depth of views.

It is rendered from Gaussians, whose own centres lie off the surface that descriptors are of, or
swept from photos.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from chebsplat.cameras import centers, unproject, upright
from chebsplat.render import SceneRenderer
from chebsplat.splats.parts import cubes_of, means_of_each
from chebsplat.views import View

OPAQUE = 0.9  # least coverage of a pixel whose depth counts
NEAREST = 0.05  # metres
EDGE = 0.06  # metres, of the cubes that one point stands for
N_PIXELS = 600_000  # that are looked at
# of the pixels in the cube of a middling pixel, and three: what floats before a view holds fewer
LEAST = 0.4
# the same where photos were swept: coarser, and counted only where views agree
EDGE_SWEPT, LEAST_SWEPT = 0.08, 0.2
LOOKOUT_SIZE, LOOKOUT_ANGLE = (192, 144), 1.4  # pixels; rad, across


class Surface(NamedTuple):
    """M points: means f64 [M, 3] scene units; eyes f64 [M, 3], the mean of their cameras."""

    means: np.ndarray
    eyes: np.ndarray


def surface(
    parameters: Mapping[str, np.ndarray],
    cam_from_world: np.ndarray,
    Ks: np.ndarray,
    size: tuple[int, int],
    unit: float = 1.0,
    n_pixels: int = N_PIXELS,
) -> Surface:
    """Points of the surface, at most one in a cube of edge EDGE.

    Args: parameters: raw, of N Gaussians; cam_from_world [V, 4, 4] and Ks [V, 3, 3] of views of
      `size` (width, height); unit: scene units of a metre; n_pixels: that are looked at, of all
      views alike, drawn.
    Choices: depth as `render_depth` has it; points averaged by cube. How many pixels a cube needs
      follows from how many others hold: in a wide room, or of few pixels, all hold fewer.
    """
    renderer, (width, height) = SceneRenderer(dict(parameters)), size
    rng, count = np.random.default_rng(0), min(max(n_pixels // max(len(Ks), 1), 1), width * height)
    points, eyes = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for pose, K in zip(cam_from_world, Ks, strict=True):
        view = View(torch.from_numpy(K).float(), torch.from_numpy(pose).float(), width, height)
        depth, covered = (image.ravel() for image in renderer.render_depth(view, NEAREST * unit))
        pixels = rng.choice(width * height, count, replace=False)
        pixels = pixels[(covered[pixels] > OPAQUE) & np.isfinite(depth[pixels])]
        rays = (
            np.stack([pixels % width + 0.5, pixels // width + 0.5, np.ones(len(pixels))], 1)
            @ np.linalg.inv(K).T
        )
        points.append((rays * depth[pixels, None] - pose[:3, 3]) @ pose[:3, :3])
        eyes.append(np.tile(-pose[:3, :3].T @ pose[:3, 3], (len(pixels), 1)))
    return fused(np.concatenate(points), np.concatenate(eyes), EDGE * unit)


def swept_surface(
    depths: np.ndarray, Ks: np.ndarray, cam_from_world: np.ndarray, unit: float = 1.0
) -> Surface:
    """Points of swept depth [V, h, w], 0: none, at most one in a cube of edge EDGE_SWEPT.

    Args: Ks [V, 3, 3] in its pixels; cam_from_world [V, 4, 4]; unit: scene units of a metre.
    """
    points, eyes = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for depth, K, pose, eye in zip(
        depths, Ks, cam_from_world, centers(cam_from_world), strict=True
    ):
        points.append(unproject(depth, K, pose, np.argwhere(depth > 0)))
        eyes.append(np.tile(eye, (len(points[-1]), 1)))
    return fused(np.concatenate(points), np.concatenate(eyes), EDGE_SWEPT * unit, LEAST_SWEPT)


def lookouts(
    means: np.ndarray, opacities: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Views [V, 4, 4] of LOOKOUT_SIZE within a room, and their K, for a splat without cameras.

    Args: means [N, 3] scene units, opacities [N] in (0, 1); up [3] unit.
    Choices: nine places about the middle of what is opaque, at half its height, looking six ways,
      and up and down.
    """
    turn = upright(up)
    solid = means[opacities > 0.5] if (opacities > 0.5).any() else means
    low, high = np.quantile(solid @ turn.T, (0.02, 0.98), axis=0)
    width, height = LOOKOUT_SIZE
    focal = width / 2 / np.tan(LOOKOUT_ANGLE / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    poses = []
    for x, y in np.ndindex(3, 3):
        eye = low + (high - low) * (0.3 + 0.2 * x, 0.3 + 0.2 * y, 0.5)
        for yaw, pitch in itertools.product(np.arange(6) * np.pi / 3, (0.25, -0.6)):
            ahead = np.array(
                [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
            )
            right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
            rotation = np.stack([right, np.cross(ahead, right), ahead])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation @ turn, -rotation @ eye
            poses.append(pose)
    return np.stack(poses), np.tile(K, (len(poses), 1, 1))


def fused(points: np.ndarray, eyes: np.ndarray, edge: float, least: float = LEAST) -> Surface:
    """Mean of the points, and of their eyes, in each cube of this edge that has enough of them."""
    if len(points) == 0:
        return Surface(points, eyes)
    cube = np.unique(cubes_of(points, edge), return_inverse=True)[1]
    _, middles, means = means_of_each(cube, least, points, eyes)
    return Surface(middles, means)
