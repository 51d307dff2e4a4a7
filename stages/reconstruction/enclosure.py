"""Walls, floor and ceiling of a room, continued where no photo looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.cameras import centers, unproject
from chebsplat.labels.agreement import project, unhidden
from chebsplat.shape.room import LEAST_BOXED, room_axes, sides_of
from chebsplat.splats.gaussians import local_shape

# of `unique_share`: at most .01 in 17 scenes of 52 to 105 photos, at least .15 in 13 of 6 or 10
FEW = 0.05
N_ASKED, PER_SIDE, HARDLY_ANY = 12, 40, 0.01  # views; pixels a side; part of a view
# that give a point its normal: of 16 the noise of a depth camera hides a room's directions
N_NEIGHBORS = 64
# of the shares of `room_axes`: seven rooms have .04 at least, six other scenes .02 at most
LEAST_OF_EACH = 0.03
BEFORE = 0.97  # of a pixel's depth: nearer than this is free space


def enclosed(
    cloud: dict[str, Any],
    views: np.ndarray,
    depth: Callable[[int], np.ndarray],
    size: tuple[int, int],
) -> tuple[dict[str, Any], str]:
    """means, colors and seen_from of points on the sides of a room in cells that no photo shows, as
    a cloud has them, none where photos leave out little, or it is no room; and why not.

    Args: views: of the cloud's, those that are trained on; depth: of one of these f32 [H, W], not
      positive where unknown; size: (W, H).
    Choices: none where photos show nearly all (`unique_share`): what is behind things stays behind
      them. A photo shows a cell unless its depth there is less, or unknown. A room has LEAST_BOXED
      of its points across three directions, and LEAST_OF_EACH across each. A point is seen from the
      nearest camera.
    """
    none = {key: cloud[key][:0] for key in ("means", "colors", "seen_from")}
    alone = unique_share(cloud, views, depth, size)
    if alone < FEW:
        return none, f"a photo shows {100 * alone:.0f} % that no other does"
    means, eyes = cloud["means"], centers(cloud["cam_from_world"])[views]
    normals = local_shape(means, N_NEIGHBORS)[1].astype(np.float64)
    axes, shares = room_axes(normals, np.ones(len(means)))
    if sum(shares) < LEAST_BOXED or min(shares) < LEAST_OF_EACH:
        percent = ", ".join(f"{100 * share:.0f}" for share in shares)
        return none, f"{percent} % of the points face along three directions: this is no room"
    points, colors = sides_of(means, normals, cloud["colors"], axes, eyes)
    visible = np.zeros(len(points), bool)
    for k in views:
        image = project(points, cloud["Ks"][k], cloud["cam_from_world"][k], size)
        inside = np.flatnonzero(np.isfinite(image[:, 0]))
        columns, rows = image[inside, :2].astype(int).T
        visible[inside] |= BEFORE * image[inside, 2] < depth(k)[rows, columns]
    points, colors = points[~visible], colors[~visible]
    nearest = cKDTree(eyes).query(points)[1]
    return {"means": points, "colors": colors, "seen_from": views[nearest]}, ""


def unique_share(
    cloud: dict[str, Any],
    views: np.ndarray,
    depth: Callable[[int], np.ndarray],
    size: tuple[int, int],
) -> float:
    """Share of what a view shows that no other does, arguments as of `enclosed`: about as much of
    another photo would be new.

    Choices: mean over up to N_ASKED views, of a grid of PER_SIDE pixels along the longer side. When
      no more than HARDLY_ANY of a view is left, no further ones are looked at.
    """
    shares, rng = [], np.random.default_rng(0)
    for k in views[:: -(-len(views) // N_ASKED)]:
        surface = depth(k)
        step = -(-max(surface.shape) // PER_SIDE)
        measured = np.isfinite(surface) & (surface > 0)
        pixels = np.argwhere(measured[::step, ::step]) * step
        left = unproject(surface, cloud["Ks"][k], cloud["cam_from_world"][k], pixels)
        for other in rng.permutation(views[views != k]):
            if len(left) <= HARDLY_ANY * len(pixels):
                break
            image = project(left, cloud["Ks"][other], cloud["cam_from_world"][other], size)
            left = left[~unhidden(image, size, depth(other))]
        shares.append(len(left) / max(len(pixels), 1))
    return float(np.mean(shares))
