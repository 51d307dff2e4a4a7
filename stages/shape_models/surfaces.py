"""Points of a scene's surface to describe shape at: from depth, from a plane sweep, or a splat."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from chebsplat.cameras import common_up, resized, upright
from chebsplat.errors import DataFailure
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.points import Points
from chebsplat.formats.world import World
from chebsplat.lifting.smoothing import room_unit
from chebsplat.lifting.surface import surface, swept_surface
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.reconstruction.thinning import even

log = logging.getLogger("chebsplat")
LEAST_SURE = 0.5  # of up, by the cameras
LEAST_SWEPT = 0.5  # of the pixels of a capture without depth, that must have swept depth
# sources whose scene unit is the metre
METRIC = ("generated", "replica", "scannet", "seven_scenes")
N_NEIGHBORS = 16  # that give a point its normal and covariance


class Cloud(NamedTuple):
    """Points of a surface: means [P, 3], unit normals towards a camera, covariances [P, 3, 3]."""

    means: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray


def from_depth(points: Points) -> Cloud:
    """The surface of points of depth, evenly spaced, as knowledge was trained on.

    Raises: DataFailure where there are too few.
    Choices: points where no photo looks, which stand last, are none of it: with a room's extended
      sides in the descriptors the labels of six photos were worse in a house of others.
    """
    n = len(points.means) - points.notes.get("n_on_sides", 0) - points.notes.get("n_behind", 0)
    if n <= N_NEIGHBORS:
        raise DataFailure(f"the depth shows {n} points of a surface; shape cannot be told")
    rows = even(points)
    rows = rows[rows < n]
    if len(rows) == len(points.means):
        return Cloud(points.means, points.normals, points.covariances)
    means = points.means[rows]
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, points.normals[rows]) < 0] *= -1
    return Cloud(means, normals, covariances)


def from_splat(
    parameters: dict[str, np.ndarray],
    poses: np.ndarray,
    Ks: np.ndarray,
    size: tuple[int, int],
    unit: float,
) -> Cloud:
    """The surface that Gaussians show to views, for splats without points of depth.

    Raises: DataFailure where they show too little of one.
    """
    means, eyes = surface(parameters, poses, Ks, size, unit)
    if len(means) <= N_NEIGHBORS:
        raise DataFailure(
            f"the Gaussians show {len(means)} points of a surface; shape cannot be told"
        )
    return facing(means, eyes)


def from_sweep(points: Points, width: int, unit: float) -> Cloud:
    """The surface of swept depth, of photos of this width.

    Raises: DataFailure where that is too little of one.
    """
    assert points.depths is not None
    Ks = swept_Ks(points, width)
    means, eyes = swept_surface(points.depths, Ks, points.cam_from_world, unit)
    if len(means) <= N_NEIGHBORS:
        raise DataFailure(
            f"the photos' depth shows {len(means)} points of a surface; shape cannot be told"
        )
    return facing(means, eyes)


def swept_Ks(points: Points, width: int) -> np.ndarray:
    """Intrinsics [V, 3, 3] in pixels of swept depth, of photos of this width in pixels."""
    assert points.depths is not None
    factor = width // points.depths.shape[2]  # of the block of pixels that a swept one stands for
    return resized(points.Ks, 1 / factor, 1 / factor)


def facing(means: np.ndarray, eyes: np.ndarray) -> Cloud:
    """Points [P, 3] with local covariances, and normals towards the cameras `eyes` [P, 3]."""
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, eyes - means) < 0] *= -1
    return Cloud(means, normals, covariances)


def up_of(poses: np.ndarray) -> tuple[np.ndarray, float]:
    """Up [3] by the cameras, and its certainty; z, with a warning, where they disagree."""
    up, sure = common_up(poses)
    if sure >= LEAST_SURE:
        return up, sure
    log.warning("the cameras do not tell which way is up (%.2f); z is taken", sure)
    return np.array([0.0, 0.0, 1.0]), sure


def scene_unit(capture: Capture | None, means: np.ndarray) -> tuple[float, str]:
    """Scene units of a metre, by `source`, if metric or with depth, else by `extent`; and which."""
    if capture is not None and (capture.depth is not None or capture.source.get("kind") in METRIC):
        return 1 / World.read(capture.source).scale, "source"
    return room_unit(means), "extent"


def surface_in(capture: Capture, points: Points, unit: float) -> tuple[Cloud, str]:
    """The surface by the capture's depth, or by a sweep of its photos, and which of both it is.

    Raises: DataFailure where neither shows enough of one.
    Choices: where fewer than LEAST_SWEPT of the pixels have swept depth, walls are missing about
      objects: shape was right for 70 % of the Gaussians near its points, smoothed features for 82 %
      (two rooms, ten photos each). On the surface of Gaussians of ten photos it is right for half.
    """
    if capture.depth is not None:
        return from_depth(points), "depth"
    if points.depths is None:
        raise DataFailure("the capture has no depth, and its photos were not swept for any")
    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    share = float(np.mean(points.depths[used] > 0)) if used else 0.0
    if share < LEAST_SWEPT:
        raise DataFailure(
            f"the capture has no depth, and a sweep of its photos finds that of {share:.0%} of "
            "their pixels: too little"
        )
    return from_sweep(points, capture.size[0], unit), "swept depth"


def in_scene(of: Descriptors) -> tuple[np.ndarray, np.ndarray]:
    """Described points in the scene's own frame and units: means and unit normals f64 [N, 3]."""
    turn = upright(np.array(of.up))
    return of.means.astype(np.float64) @ turn * of.unit + of.origin, of.normals.astype(
        np.float64
    ) @ turn
