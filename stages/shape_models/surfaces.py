"""Points of a scene's surface, as shape is described of them: where depth shows it, a sweep, or a
splat.
"""

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
LEAST_TOLD = 0.5  # of the pixels of a capture without depth, which a sweep must have found
# sources whose scene unit is the metre
METRIC = ("generated", "replica", "scannet", "seven_scenes")
N_NEIGHBORS = 16  # that give a point its normal and covariance


class Cloud(NamedTuple):
    """Points of a surface: means [P, 3] scene units, normals [P, 3] unit, towards a camera,
    covariances [P, 3, 3].
    """

    means: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray


def measured(points: Points) -> Cloud:
    """The surface that points of depth show, as evenly as knowledge was taught it.

    Raises: DataFailure where they show too little of one.
    """
    if len(points.means) <= N_NEIGHBORS:
        raise DataFailure(
            f"the depth shows {len(points.means)} points of a surface; shape cannot be told"
        )
    kept = even(points)
    if len(kept) == len(points.means):
        return Cloud(points.means, points.normals, points.covariances)
    means = points.means[kept]
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, points.normals[kept]) < 0] *= -1
    return Cloud(means, normals, covariances)


def shown(
    parameters: dict[str, np.ndarray],
    poses: np.ndarray,
    Ks: np.ndarray,
    size: tuple[int, int],
    unit: float,
) -> Cloud:
    """The surface that Gaussians show to views, for scenes whose points no depth has measured.

    Raises: DataFailure where they show too little of one.
    """
    means, eyes = surface(parameters, poses, Ks, size, unit)
    if len(means) <= N_NEIGHBORS:
        raise DataFailure(
            f"the Gaussians show {len(means)} points of a surface; shape cannot be told"
        )
    return facing(means, eyes)


def swept(points: Points, width: int, unit: float) -> Cloud:
    """The surface that swept depth of photos of this width shows.

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
    """Points [P, 3] with the shape of their neighbours, and normals towards the cameras [P, 3] that
    saw them.
    """
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, eyes - means) < 0] *= -1
    return Cloud(means, normals, covariances)


def up_of(poses: np.ndarray) -> tuple[np.ndarray, float]:
    """Against gravity [3], and how sure that is. Choices: z, with a warning, where the cameras
    cannot tell.
    """
    up, sure = common_up(poses)
    if sure >= LEAST_SURE:
        return up, sure
    log.warning("the cameras do not tell which way is up (%.2f); z is taken", sure)
    return np.array([0.0, 0.0, 1.0]), sure


def scene_unit(capture: Capture | None, means: np.ndarray) -> tuple[float, str]:
    """Scene units of a metre, and what says so: the source's where it is metric or has depth,
    otherwise the extent.
    """
    if capture is not None and (capture.depth is not None or capture.source.get("kind") in METRIC):
        return 1 / World.read(capture.source).scale, "source"
    return room_unit(means), "extent"


def surface_in(capture: Capture, points: Points, unit: float) -> tuple[Cloud, str]:
    """The surface that the capture's depth shows, or a sweep of its photos, and which of both it
    is.

    Raises: DataFailure where neither shows enough of one.
    Choices: where fewer than half of the pixels have swept depth, things stand alone that walls
      surround: shape was right for 70 % of what is near its points, where smoothed features were
        for 82 % (two rooms, ten photos each).
      What Gaussians show that ten photos have placed is right for half of them.
    """
    if capture.depth is not None:
        return measured(points), "depth"
    if points.depths is None:
        raise DataFailure("the capture has no depth, and its photos were not swept for any")
    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    share = float(np.mean(points.depths[used] > 0)) if used else 0.0
    if share < LEAST_TOLD:
        raise DataFailure(
            f"the capture has no depth, and a sweep of its photos finds that of {share:.0%} of "
            "their pixels: too little"
        )
    return swept(points, capture.size[0], unit), "swept depth"


def in_scene(of: Descriptors) -> tuple[np.ndarray, np.ndarray]:
    """Described points in the scene's own frame and units: means and unit normals f64 [N, 3]."""
    turn = upright(np.array(of.up))
    return of.means.astype(np.float64) @ turn * of.unit + of.origin, of.normals.astype(
        np.float64
    ) @ turn
