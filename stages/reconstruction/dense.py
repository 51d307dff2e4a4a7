"""Points beside matched ones: from depth by a plane sweep, and a backdrop far behind all others."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import torch
from PIL import Image

from chebsplat.cameras import centers, unproject
from chebsplat.formats.capture import Capture
from chebsplat.photos.planar import completed
from chebsplat.photos.plane_sweep import agreed, swept_depth
from chebsplat.splats.parts import cubes_of, means_of_each
from chebsplat.stages.reconstruction.thinning import edge_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import SfmSection

log = logging.getLogger("chebsplat")

SIDE = 160  # pixels of the longer side that photos are reduced to
# depths that are tried, evenly spaced in 1 / z; views that each is compared with
DEPTHS, NEIGHBORS = 96, 8
WITNESSES = 64  # views, the nearest, that confirm or deny a view's depth
# of the nearest point in a photo (1st percentile), and of the farthest one in any (99th)
NEAR, FAR = 0.7, 5.0
MOST_COST, AGREE = 0.5, 2  # of a depth that counts: cost at most, views that confirm it
# of the points in a median cube, and at least three: surfaces of few pixels are mostly wrong
LEAST = 0.2
MOST = 12_000  # points in all: the first Gaussians, which growth needs room beside
CELLS = 20  # cells along the longer side of a photo, for the share of cells that hold a point
# of the pairs of cameras: of photos all around an object .35, of five other captures at most .2
FACING = 0.25
BEHIND = 1.5  # times the farthest point: the depth of the backdrop
COVERED = 0.8  # part of the cells under which matched points leave too much of the photos empty


def covered(Ks: np.ndarray, poses: np.ndarray, means: np.ndarray, size: tuple[int, int]) -> float:
    """Share of the views' cells, CELLS along the longer side of `size`, that hold a point."""
    return float(
        np.mean([cells_with(K, pose, means, size) for K, pose in zip(Ks, poses, strict=True)])
    )


def cells_with(
    K: np.ndarray, pose: np.ndarray, means: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Cells of a photo of `size` (width, height) that hold a point [N, 3], bool [rows, columns]."""
    edge = max(size) / CELLS
    occupied = np.zeros((math.ceil(size[1] / edge), math.ceil(size[0] / edge)), bool)
    column, row = (in_photo(K, pose, means, size)[:, :2] // edge).astype(int).T
    occupied[row, column] = True
    return occupied


def in_photo(
    K: np.ndarray, pose: np.ndarray, means: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Pixels and depth [M, 3] of the points [N, 3] within a photo of `size` (width, height)."""
    camera = means @ pose[:3, :3].T + pose[:3, 3]
    camera = camera[camera[:, 2] > 0]
    pixels = (camera @ K.T)[:, :2] / camera[:, 2:]
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    return np.concatenate([pixels, camera[:, 2:]], 1)[inside]


def wants_more(job: Job, capture: Capture, cloud: dict[str, Any], settings: SfmSection) -> bool:
    """True where `sfm.dense` adds points to a cloud; auto: where much of the photos is empty.

    Choices: depth that a capture brings, and generated views, which have it, need none of this.
    """
    if settings.dense != "auto" or capture.depth is not None:
        return settings.dense == "on"
    share = covered(cloud["Ks"], cloud["cam_from_world"], cloud["means"], capture.size)
    job.facts["covered"] = share
    log.info("%d points lie in %.0f %% of the photos' cells", len(cloud["means"]), 100 * share)
    return share < COVERED


def swept(job: Job, capture: Capture, cloud: dict[str, Any]) -> dict[str, Any]:
    """means, colors and seen_from of points by a plane sweep of the training views, as a cloud has
    them, and depths f32 [V, h, w] of the cloud's views, of photos reduced to SIDE, 0 where views do
    not agree.

    Choices: test views give no points, and have no depth. Points in the photo alone bound the
      depths that are tried: others, beside the camera, would draw these towards it.
    """
    row = {name: k for k, name in enumerate(capture.names)}
    rows = np.array([row[name] for name in cloud["names"]])
    used = np.flatnonzero(~capture.is_test[rows])
    factor = max(round(max(capture.size) / SIDE), 1)
    small = np.stack([reduced(capture.images[view], factor) for view in rows[used]]) / 255
    valid = np.ones(small.shape[:3], np.float32)
    if capture.loss_mask is not None:
        valid = np.stack(
            [reduced(capture.loss_mask[view][..., None], factor)[..., 0] for view in rows[used]]
        )
    poses, Ks = cloud["cam_from_world"][used], cloud["Ks"][used].copy()
    z = [
        in_photo(K, pose, cloud["means"], capture.size)[:, 2]
        for K, pose in zip(Ks, poses, strict=True)
    ]
    Ks[:, :2] /= factor
    sweep = depth_of_photos(small, valid, Ks, poses, z, job.progress)
    depths = np.zeros((len(rows), *small.shape[1:3]), np.float32)
    depths[used] = sweep
    means, colors, view_of = (
        [np.zeros((0, 3))],
        [np.zeros((0, 3), np.uint8)],
        [np.zeros(0, np.int64)],
    )
    for view, index in enumerate(used):
        pixels = np.argwhere(sweep[view] > 0)
        means.append(unproject(sweep[view], Ks[view], poses[view], pixels))
        colors.append((small[view][tuple(pixels.T)] * 255).round().astype(np.uint8))
        view_of.append(np.full(len(pixels), index))
    points = fused(np.concatenate(means), np.concatenate(colors), np.concatenate(view_of))
    total, count = sum(map(len, means)), len(points["means"])
    share = total / max(sweep.size, 1)
    log.info(
        "a sweep of %d photos finds %.0f %% of their pixels' depth, %d points",
        len(used),
        100 * share,
        count,
    )
    job.facts["swept"] = round(share, 3)
    return points | {"depths": depths}


def depth_of_photos(
    colors: np.ndarray,
    valid: np.ndarray,
    Ks: np.ndarray,
    poses: np.ndarray,
    z: list[np.ndarray],
    progress: Progress | None = None,
) -> np.ndarray:
    """Depth f32 [V, h, w] of photos by a plane sweep, by planes where texture lacks; 0 unknown.

    Args: colors f32 [V, h, w, 3] in [0, 1]; valid [V, h, w]: 1 where a pixel counts; Ks [V, 3, 3]
      in its pixels; poses [V, 4, 4]; z: of each photo, the depths of some points in it.
    Choices: a pixel counts where AGREE of the other views have its depth, and few see through it;
      so does what planes add to these.
    """
    from chebsplat.stages.reconstruction.matching import apart

    bounds = np.array(
        [np.percentile(some, (1, 99)) if len(some) else (np.nan, np.nan) for some in z]
    )
    near, far = NEAR * bounds[:, 0], FAR * np.nanmax(bounds[:, 1])
    cost = apart(poses)
    nearest = np.where(np.isfinite(np.sort(cost)), np.argsort(cost), -1)
    grey, counts = torch.from_numpy(colors.mean(-1)).float(), torch.from_numpy(valid).float()
    cameras = torch.from_numpy(Ks).float(), torch.from_numpy(poses).float()
    depth = np.zeros(colors.shape[:3], np.float32)
    views = range(len(colors))
    for view, _ in (
        progress.track(views, len(colors), "depth of photos")
        if progress
        else ((v, None) for v in views)
    ):
        neighbors = [int(k) for k in nearest[view, :NEIGHBORS] if k >= 0]
        if np.isfinite(near[view]) and len(neighbors) >= AGREE:
            tried = 1 / torch.linspace(1 / float(near[view]), 1 / float(far), DEPTHS)
            best, costs = swept_depth(grey, counts, *cameras, view, neighbors, tried)
            depth[view] = torch.where((costs < MOST_COST) & (counts[view] > 0.9), best, 0).numpy()
    witnesses = nearest[:, :WITNESSES]
    depth = agreed(depth, Ks, poses, witnesses, AGREE)
    whole = np.stack([completed(*photo) for photo in zip(depth, colors, strict=True)])
    return agreed(np.where(valid > 0.9, whole, 0), Ks, poses, witnesses, AGREE)


def fused(means: np.ndarray, colors: np.ndarray, seen_from: np.ndarray) -> dict[str, Any]:
    """Means of the points in each cube that holds enough of them (LEAST); seen_from: the first's.

    Choices: twice as many cubes as MOST, since outliers off the surfaces fill half of them.
    """
    if len(means) == 0:
        return {"means": means, "colors": colors, "seen_from": seen_from}
    numbers = cubes_of(means, edge_of(means, 2 * MOST))
    _, first, cube = np.unique(numbers, return_index=True, return_inverse=True)
    is_dense, middle, color = means_of_each(cube, LEAST, means, colors)
    return {
        "means": middle,
        "colors": color.round().astype(np.uint8),
        "seen_from": seen_from[first[is_dense]],
    }


def facing(poses: np.ndarray) -> float:
    """Share of pairs of cameras [V, 4, 4] that face one another, looking more than 90° apart."""
    eyes, forward = centers(poses), poses[:, 2, :3]
    before = np.einsum("ijk,ik->ij", eyes - eyes[:, None], forward) > 0
    return float((before & before.T & (forward @ forward.T < 0)).mean())


def backdrop(capture: Capture, cloud: dict[str, Any]) -> dict[str, Any]:
    """means, colors and seen_from of points far behind all others, as a cloud has them: one in each
    cell of a training photo in which no point lies, of that cell's mean colour.

    Choices: none unless FACING of the pairs of cameras face one another: without a backdrop
      training fills such a cell with Gaussians near its camera, in the way of the opposite ones.
      Its depth is BEHIND times that of the farthest point in any photo (99th percentile).
    """
    row, (width, height) = {name: k for k, name in enumerate(capture.names)}, capture.size
    Ks, poses = cloud["Ks"], cloud["cam_from_world"]
    used = [k for k, name in enumerate(cloud["names"]) if not capture.is_test[row[name]]] * (
        facing(poses) > FACING
    )
    depths = [in_photo(Ks[k], poses[k], cloud["means"], capture.size)[:, 2] for k in used]
    far = BEHIND * max((np.percentile(z, 99) for z in depths if len(z)), default=0.0)
    means, colors, view_of = (
        [np.zeros((0, 3))],
        [np.zeros((0, 3), np.uint8)],
        [np.zeros(0, np.int64)],
    )
    for k in used:
        empty = ~cells_with(Ks[k], poses[k], cloud["means"], capture.size)
        view = row[cloud["names"][k]]
        small = Image.fromarray(capture.images[view]).resize(
            empty.shape[::-1], Image.Resampling.BOX
        )
        if capture.loss_mask is not None:
            counted = Image.fromarray(capture.loss_mask[view]).resize(
                empty.shape[::-1], Image.Resampling.NEAREST
            )
            empty &= np.asarray(counted)
        pixels = np.argwhere(empty)
        scale = np.array([empty.shape[1] / width, empty.shape[0] / height, 1.0])
        means.append(unproject(np.full(empty.shape, far), scale[:, None] * Ks[k], poses[k], pixels))
        colors.append(np.asarray(small)[tuple(pixels.T)])
        view_of.append(np.full(len(pixels), k))
    return {
        "means": np.concatenate(means),
        "colors": np.concatenate(colors),
        "seen_from": np.concatenate(view_of),
    }


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means f32 of blocks of `factor` pixels a side of an image [H, W, C]."""
    height, width = (side // factor for side in image.shape[:2])
    blocks = np.asarray(image[: height * factor, : width * factor], np.float32)
    return np.asarray(blocks.reshape(height, factor, width, factor, -1).mean((1, 3)))
