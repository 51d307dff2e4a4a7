"""Points between those that were matched: depth of the photos by a plane sweep, where several views agree on it."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.stages.settings import SfmSection

log = logging.getLogger("chebsplat")

SIDE = 160  # pixels of the longer side that photos are reduced to
DEPTHS, NEIGHBORS = 48, 8  # depths that are tried, evenly spaced in 1 / z; views that each is compared with
NEAR, FAR = 0.7, 5.0  # of the nearest point in a photo (1st percentile), and of the farthest one in any (99th)
MOST_COST, TOLERANCE, AGREE = 0.5, 0.02, 2  # what counts: cost, relative difference in depth, neighbours of that depth
LEAST = 0.2  # of the points in the cube of a middling one, and three: what few pixels show is seldom there
MOST = 12_000  # points in all: the first Gaussians, which growth needs room beside
CELLS = 20  # cells along the longer side of a photo, of which it is asked how many hold a point
COVERED = 0.8  # part of the cells under which matched points leave too much of the photos empty


def covered(Ks: np.ndarray, poses: np.ndarray, means: np.ndarray, size: tuple[int, int]) -> float:
    """The share of the views' cells, CELLS along the longer side of `size`, in which a point [N, 3] lies."""
    import numpy as np

    width, height = size
    edge = max(size) / CELLS
    columns, rows = int(np.ceil(width / edge)), int(np.ceil(height / edge))
    shares = []
    for K, pose in zip(Ks, poses, strict=True):
        cells = (in_photo(K, pose, means, size)[:, :2] // edge).astype(int)
        shares.append(len(np.unique(cells[:, 1] * columns + cells[:, 0])) / (columns * rows))
    return float(np.mean(shares))


def in_photo(K: np.ndarray, pose: np.ndarray, means: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels and depth [M, 3] of those of the points [N, 3] that lie in a photo of `size` (width, height)."""
    import numpy as np

    camera = means @ pose[:3, :3].T + pose[:3, 3]
    camera = camera[camera[:, 2] > 0]
    pixels = (camera @ K.T)[:, :2] / camera[:, 2:]
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    return np.concatenate([pixels, camera[:, 2:]], 1)[inside]


def wants_more(job: Job, capture: Capture, cloud: dict[str, Any], settings: SfmSection) -> bool:
    """Whether points are added to a cloud, as `sfm.dense` says: to those that leave much of the photos empty.

    Choices: depth that a capture brings, and generated views, which have it, need none of this.
    """
    if settings.dense != "auto" or capture.depth is not None:
        return settings.dense == "on"
    share = covered(cloud["Ks"], cloud["cam_from_world"], cloud["means"], capture.size)
    job.facts["covered"] = share
    log.info("%d points lie in %.0f %% of the photos' cells", len(cloud["means"]), 100 * share)
    return share < COVERED


def swept(job: Job, capture: Capture, cloud: dict[str, Any]) -> dict[str, Any]:
    """means, colors and seen_from of points that a plane sweep of the training views finds, as a cloud has them, and
    depths f32 [V, h, w] of the cloud's views, 0 where they do not agree, of photos reduced to SIDE.

    Choices: test views give no points, and have no depth. A pixel counts where two of eight neighbours have its depth
      within 2 %; its point lies at the mean of what they have. Depths that are tried begin before what is in the photo:
      points behind its edges, beside the camera, would have all of them end there.
    """
    import numpy as np
    import torch

    from chebsplat.photos.plane_sweep import agreed, rays, swept_depth
    from chebsplat.stages.view_pairs import apart

    row = {name: k for k, name in enumerate(capture.names)}
    rows = np.array([row[name] for name in cloud["names"]])
    used = np.flatnonzero(~capture.is_test[rows])
    factor = max(round(max(capture.size) / SIDE), 1)
    small = torch.stack([_reduced(capture.images[view], factor) for view in rows[used]]) / 255
    valid = torch.ones(small.shape[:3])
    if capture.loss_mask is not None:
        valid = torch.stack([_reduced(capture.loss_mask[view][..., None], factor)[..., 0] for view in rows[used]])
    poses = torch.from_numpy(cloud["cam_from_world"][used]).float()
    Ks = torch.from_numpy(cloud["Ks"][used]).float()
    Ks[:, :2] /= factor
    cameras = zip(cloud["Ks"][used], cloud["cam_from_world"][used], strict=True)
    z = [in_photo(*camera, cloud["means"], capture.size)[:, 2] for camera in cameras]
    bounds = np.array([np.percentile(some, (1, 99)) if len(some) else (np.nan, np.nan) for some in z])
    near, far = NEAR * bounds[:, 0], FAR * np.nanmax(bounds[:, 1])
    cost = apart(cloud["cam_from_world"][used])
    neighbors = [[int(k) for k in np.argsort(line)[:NEIGHBORS] if np.isfinite(line[k])] for line in cost]
    depth, costs = torch.full(small.shape[:3], torch.nan), torch.full(small.shape[:3], torch.inf)
    grey = small.mean(-1)
    for view, _ in job.progress.track(range(len(used)), len(used), "depth of photos"):
        if np.isfinite(near[view]) and len(neighbors[view]) >= AGREE:
            tried = 1 / torch.linspace(1 / float(near[view]), 1 / float(far), DEPTHS)
            depth[view], costs[view] = swept_depth(grey, valid, Ks, poses, view, neighbors[view], tried)
    depths = np.zeros((len(rows), *small.shape[1:3]), np.float32)
    means, colors, seen = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0, np.int64)]
    for view in range(len(used)):
        count, mean = agreed(depth, Ks, poses, view, neighbors[view], TOLERANCE)
        kept = (count >= AGREE) & (costs[view] < MOST_COST) & (valid[view] > 0.9)
        depths[used[view]] = torch.where(kept, mean, 0).numpy()
        points = (rays(Ks[view], *grey.shape[1:]) * mean.reshape(-1)).T[kept.reshape(-1)].double().numpy()
        pose = cloud["cam_from_world"][used[view]]
        means.append((points - pose[:3, 3]) @ pose[:3, :3])
        colors.append((small[view][kept] * 255).round().byte().numpy())
        seen.append(np.full(len(points), used[view]))
    found = fused(np.concatenate(means), np.concatenate(colors), np.concatenate(seen))
    total, count_ = sum(map(len, means)), len(found["means"])
    log.info("a plane sweep of %d photos finds the depth of %d pixels, %d points", len(used), total, count_)
    return found | {"depths": depths}


def fused(means: np.ndarray, colors: np.ndarray, seen_from: np.ndarray) -> dict[str, Any]:
    """The means of the points in each cube that holds enough of them (LEAST); seen from where the first of them is.

    Choices: of twice as many cubes as points are wanted, since what lies off the surfaces fills half of them.
    """
    import numpy as np

    from chebsplat.stages.thinning import cubes

    if len(means) == 0:
        return {"means": means, "colors": colors, "seen_from": seen_from}
    first, cube, count = cubes(means, 2 * MOST)
    kept = count >= max(3, LEAST * np.median(count[cube]))
    sums = np.zeros((2, len(count), 3))
    np.add.at(sums[0], cube, means)
    np.add.at(sums[1], cube, colors)
    middle, color = sums[:, kept] / count[kept, None]
    return {"means": middle, "colors": color.round().astype(np.uint8), "seen_from": seen_from[first[kept]]}


def _reduced(image: np.ndarray, factor: int) -> Any:
    """Means of blocks of [H, W, C], f32."""
    import torch

    height, width = (side // factor for side in image.shape[:2])
    blocks = torch.from_numpy(image[: height * factor, : width * factor]).float()
    return blocks.reshape(height, factor, width, factor, -1).mean((1, 3))
