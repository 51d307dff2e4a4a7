"""Depth of posed photos by a plane sweep: agreement of views at each of many depths (Collins 1996;
MVSNet's volumes).

Then depths of a photo that others confirm, and do not see through.

Images are grey f32 [V, H, W] in [0, 1], reduced; cameras K [V, 3, 3] in their pixels (centres at
half integers) and cam_from_world [V, 4, 4]; depth is z in scene units.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from chebsplat.kernels.jit import kernel
from chebsplat.kernels.threads import in_parts

# half widths in pixels: of the patches that are compared, and of the mean over their costs
WINDOW, SMOOTH = 1, 1
FLAT = 1e-4  # added to variances: two patches without texture are alike
BRIGHT = 0.3  # weight of a difference in brightness, as a logarithm, beside 1 - correlation
OUTSIDE = 4.0  # cost of a pixel that the other view does not see
AT_ONCE = 8  # depths: what they take stays in a processor's cache
BEST = 2  # views that must agree, of the neighbours: others may be covered
# of a point's depth: what differs by less confirms it, what lies farther by more denies it
SAME, THROUGH = 0.03, 0.05
DENIED = 0.5  # views that may deny a point, for each that confirms it


def box_mean(values: Tensor, half: int) -> Tensor:
    """Mean over a square window of each pixel of [..., H, W], the border repeated."""
    (height, width), side = values.shape[-2:], 2 * half + 1
    padded = F.pad(values.reshape(-1, 1, height, width), (half,) * 4, mode="replicate")[:, 0]
    rows = padded[:, :height].clone()
    for shift in range(1, side):
        rows += padded[:, shift : shift + height]
    total = rows[..., :width].clone()
    for shift in range(1, side):
        total += rows[..., shift : shift + width]
    return total.div_(side**2).reshape(values.shape)


def rays(K: Tensor, height: int, width: int) -> Tensor:
    """Directions [3, H W] of a camera's pixels, with z = 1."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels: Tensor = torch.stack([x, y, torch.ones_like(x)]).reshape(3, -1)
    directions: Tensor = torch.linalg.inv(K) @ pixels
    return directions


def swept_depth(
    grey: Tensor,
    valid: Tensor,
    Ks: Tensor,
    poses: Tensor,
    view: int,
    neighbors: list[int],
    depths: Tensor,
) -> tuple[Tensor, Tensor]:
    """The depth [H, W] of a view at which its neighbours look most like it, and its cost [H, W].

    Args:    valid f32 [V, H, W]: 1 where a pixel counts; depths [D], evenly spaced in 1 / z.
    Choices: the cost is one minus the correlation of patches, which no exposure changes, and a
      little of the difference in brightness, without which flat patches are alike at any depth; of
      the neighbours the best two count. The lowest point of the parabola through three costs lies
      between the depths that were tried.
    """
    height, width = grey.shape[1:]
    mean, spread = _moments(grey[view])
    lowest = torch.full((BEST, len(depths), height, width), OUTSIDE)  # costs, ascending
    for other in neighbors:
        between = poses[other] @ torch.linalg.inv(poses[view])
        ahead = Ks[other] @ between[:3, :3] @ rays(Ks[view], height, width)
        pair = torch.stack([grey[other], valid[other]])[None]
        for some, ranks in zip(depths.split(AT_ONCE), lowest.split(AT_ONCE, 1), strict=True):
            # each [D, H W]
            x, y, z = (ahead * some[:, None, None] + Ks[other] @ between[:3, 3:]).unbind(1)
            z = torch.where(z > 1e-6, z, torch.nan)
            place = torch.stack([x / z / width * 2 - 1, y / z / height * 2 - 1], -1).nan_to_num(
                nan=-9.0
            )
            sampled = F.grid_sample(
                pair.expand(len(some), -1, -1, -1),
                place.reshape(len(some), height, width, 2),
                align_corners=False,
            )
            warped, counts = sampled[:, 0], sampled[:, 1] > 0.9
            their_mean, their_spread = _moments(warped)
            covariance = box_mean(warped * grey[view], WINDOW) - their_mean * mean
            correlation = ((covariance + FLAT) / (their_spread * spread + FLAT)).clamp(-1, 1)
            brighter = (their_mean.clamp_min(1e-3) / mean.clamp_min(1e-3)).log().abs().clamp_max(1)
            cost = torch.where(counts, 1 - correlation + BRIGHT * brighter, OUTSIDE)
            higher = box_mean(cost, SMOOTH)
            for rank in ranks:
                rank[:], higher = torch.minimum(rank, higher), torch.maximum(rank, higher)
    volume = lowest.mean(0)
    best = volume.min(0)
    middle = best.indices.clamp(1, len(depths) - 2)
    before, here, after = (volume.gather(0, (middle + step)[None])[0] for step in (-1, 0, 1))
    shift = (0.5 * (before - after) / (before - 2 * here + after).clamp_min(1e-6)).clamp(-0.5, 0.5)
    shift = torch.where(middle == best.indices, shift, 0)
    return 1 / (1 / depths[best.indices] + shift * (1 / depths[1] - 1 / depths[0])), best.values


def _moments(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the patch about each pixel of [..., H, W]."""
    mean = box_mean(values, WINDOW)
    return mean, (box_mean(values.square(), WINDOW) - mean.square()).clamp_min(0).sqrt()


def agreed(
    depth: np.ndarray, Ks: np.ndarray, poses: np.ndarray, others: np.ndarray, least: int
) -> np.ndarray:
    """Depth f32 [V, h, w] that others confirm: the mean of theirs and the view's own; 0 elsewhere.

    Args: depth [V, h, w], 0 where none is known; Ks [V, 3, 3] in its pixels; cam_from_world [V, 4,
      4]; others i64 [V, M]: the views that each is compared with, -1: none; least: of them that
      must confirm a pixel.
    Choices: a view denies a point where it sees farther than that: nothing can be there. What a
      view sees before a point hides it, and does not count.
    """
    rotations, eyes = poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3:]
    to_world = np.concatenate([rotations @ np.linalg.inv(Ks), -rotations @ eyes], 2)
    into = Ks @ poses[:, :3]
    depth = np.ascontiguousarray(depth, np.float32)
    result = np.zeros_like(depth)
    in_parts(_agreed, len(depth), depth, to_world, into, others, least, result)
    return result


@kernel
def _agreed(first, last, depth, to_world, into, others, least, result):
    _, height, width = depth.shape
    for view in range(first, last):
        back = to_world[view]
        for row in range(height):
            for column in range(width):
                own = depth[view, row, column]
                if not own > 0:
                    continue
                a, b = (column + 0.5) * own, (row + 0.5) * own
                x = back[0, 0] * a + back[0, 1] * b + back[0, 2] * own + back[0, 3]
                y = back[1, 0] * a + back[1, 1] * b + back[1, 2] * own + back[1, 3]
                z = back[2, 0] * a + back[2, 1] * b + back[2, 2] * own + back[2, 3]
                confirmed, denied, ratios = 0, 0, 1.0
                for k in range(others.shape[1]):
                    other = others[view, k]
                    if other < 0:
                        break
                    m = into[other]
                    far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    if not far > 0:
                        continue
                    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / far
                    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / far
                    if not (0 <= u < width and 0 <= v < height):
                        continue
                    ratio = depth[other, int(v), int(u)] / far
                    if abs(ratio - 1) < SAME:
                        confirmed += 1
                        ratios += ratio
                    elif ratio > 1 + THROUGH:
                        denied += 1
                if confirmed >= least and denied <= DENIED * confirmed:
                    result[view, row, column] = own * ratios / (1 + confirmed)
