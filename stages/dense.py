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
DEPTHS, NEIGHBORS = 48, 4  # depths that are tried, evenly spaced in 1 / z; views that each is compared with
NEAR, FAR = 0.7, 5.0  # of a view's nearest point (1st percentile), and of any view's farthest one (99th)
MOST_COST, TOLERANCE, AGREE = 0.5, 0.05, 2  # what counts: cost, relative difference in depth, neighbours of that depth
MOST = 12_000  # points in all: the first Gaussians, which growth needs room beside
CELLS = 20  # cells along the longer side of a photo, of which it is asked how many hold a point
COVERED = 0.5  # part of the cells under which matched points leave too much of the photos empty


def covered(Ks: np.ndarray, poses: np.ndarray, means: np.ndarray, size: tuple[int, int]) -> float:
    """The share of the views' cells, CELLS along the longer side of `size`, in which a point [N, 3] lies."""
    import numpy as np

    width, height = size
    edge = max(size) / CELLS
    columns, rows = int(np.ceil(width / edge)), int(np.ceil(height / edge))
    shares = []
    for K, pose in zip(Ks, poses, strict=True):
        camera = means @ pose[:3, :3].T + pose[:3, 3]
        pixels = (camera[camera[:, 2] > 0] @ K.T) / camera[camera[:, 2] > 0, 2:]
        inside = ((pixels[:, :2] >= 0) & (pixels[:, :2] < size)).all(1)
        cells = (pixels[inside, :2] // edge).astype(int)
        shares.append(len(np.unique(cells[:, 1] * columns + cells[:, 0])) / (columns * rows))
    return float(np.mean(shares))


def wants_more(job: Job, capture: Capture, cloud: dict[str, Any], settings: SfmSection) -> bool:
    """Whether points are added to a cloud, as `sfm.dense` says: to those that leave half the photos empty.

    Choices: depth that a capture brings, and generated views, which have it, need none of this.
    """
    if settings.dense != "auto" or capture.depth is not None:
        return settings.dense == "on"
    share = covered(cloud["Ks"], cloud["cam_from_world"], cloud["means"], capture.size)
    job.facts["covered"] = share
    log.info("%d points lie in %.0f %% of the photos' cells", len(cloud["means"]), 100 * share)
    return share < COVERED


def swept(job: Job, capture: Capture, cloud: dict[str, Any]) -> dict[str, Any]:
    """means, colors and seen_from of points that a plane sweep of the training views finds, as a cloud has them.

    Choices: test views give no points. A pixel counts where two of four neighbours have its depth within 5 %.
    """
    import numpy as np
    import torch

    from chebsplat.photos.plane_sweep import n_agreeing, rays, swept_depth
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
    z = cloud["means"] @ cloud["cam_from_world"][used, 2, :3].T + cloud["cam_from_world"][used, 2, 3]  # [N, V]
    bounds = np.array(
        [np.percentile(some[some > 0], (1, 99)) if (some > 0).any() else (np.nan, np.nan) for some in z.T]
    )
    near, far = NEAR * bounds[:, 0], FAR * np.nanmax(bounds[:, 1])
    cost = apart(cloud["cam_from_world"][used])
    neighbors = [[int(k) for k in np.argsort(line)[:NEIGHBORS] if np.isfinite(line[k])] for line in cost]
    depth, costs = torch.full(small.shape[:3], torch.nan), torch.full(small.shape[:3], torch.inf)
    grey = small.mean(-1)
    for view, _ in job.progress.track(range(len(used)), len(used), "depth of photos"):
        if np.isfinite(near[view]) and len(neighbors[view]) >= AGREE:
            tried = 1 / torch.linspace(1 / float(near[view]), 1 / float(far), DEPTHS)
            depth[view], costs[view] = swept_depth(grey, valid, Ks, poses, view, neighbors[view], tried)
    means, colors, seen = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0, np.int64)]
    total = 0
    for view in range(len(used)):
        agree = n_agreeing(depth, Ks, poses, view, neighbors[view], TOLERANCE) >= AGREE
        kept = (agree & (costs[view] < MOST_COST) & (valid[view] > 0.9)).reshape(-1)
        points = (rays(Ks[view], *grey.shape[1:]) * depth[view].reshape(-1)).T[kept].double().numpy()
        pose = cloud["cam_from_world"][used[view]]
        means.append((points - pose[:3, 3]) @ pose[:3, :3])
        colors.append((small[view].reshape(-1, 3)[kept] * 255).round().byte().numpy())
        seen.append(np.full(len(points), used[view]))
        total += len(points)
    log.info("a plane sweep of %d photos finds %d points", len(used), total)
    return {"means": np.concatenate(means), "colors": np.concatenate(colors), "seen_from": np.concatenate(seen)}


def _reduced(image: np.ndarray, factor: int) -> Any:
    """Means of blocks of [H, W, C], f32."""
    import torch

    height, width = (side // factor for side in image.shape[:2])
    blocks = torch.from_numpy(image[: height * factor, : width * factor]).float()
    return blocks.reshape(height, factor, width, factor, -1).mean((1, 3))
