"""Photos that break plain matching over depths; confirmed depth (docs/method.md, section 1).

Errors of depth are the median's, relative, over the pixels that count; of what must not change the
largest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.photos.plane_sweep import agreed, rays, swept_depth

HEIGHT, WIDTH, FOCAL, VIEWS = 40, 56, 60.0, 4
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
WALL, DEPTHS = 3.0, 48  # its depth; depths that are tried, a step of which is 4 % here
DEPTH = 0.01  # a quarter of a step between depths
INNER = np.s_[6:-6, 12:-12]  # what all views see of the wall


class Photos(NamedTuple):
    """Grey [V, H, W], which pixels count, poses [V, 4, 4], and the wall's depth."""

    grey: np.ndarray
    valid: np.ndarray
    poses: np.ndarray
    depth: float = WALL


def photos(unit: float = 1.0, shift: float = 0.0, baseline: float = 0.15) -> Photos:
    """A wall of smooth noise from places side by side."""
    coarse = torch.from_numpy(np.random.default_rng(0).random((1, 1, 40, 60))).float()
    texture = (
        torch.nn.functional.interpolate(coarse, scale_factor=6, mode="bicubic")
        .numpy()[0, 0]
        .clip(0.02, 1)
    )
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    grey, poses = [], np.tile(np.eye(4), (VIEWS, 1, 1))
    for view in range(VIEWS):
        place = baseline * view
        x, y = (column - WIDTH / 2) / FOCAL * WALL + place, (row - HEIGHT / 2) / FOCAL * WALL
        grey.append(_bilinear(texture, (y + 2) * 55, (x + 2.5) * 55))
        poses[view, 0, 3] = -unit * place
    poses[:, :3, 3] -= shift
    return Photos(
        np.stack(grey).astype(np.float32),
        np.ones((VIEWS, HEIGHT, WIDTH), np.float32),
        poses,
        unit * WALL,
    )


def _bilinear(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    i, j = row.astype(int), column.astype(int)
    a, b = row - i, column - j
    top, below = (image[k, j] * (1 - b) + image[k, j + 1] * b for k in (i, i + 1))
    return np.asarray(top * (1 - a) + below * a)


def lit(*stops: float) -> Photos:
    """Photos of different exposures."""
    of = photos()
    return of._replace(grey=(of.grey * 2.0 ** np.array(stops)[:, None, None]).astype(np.float32))


def sweep(of: Photos) -> tuple[np.ndarray, np.ndarray]:
    tried = 1 / torch.linspace(1 / (0.5 * of.depth), 1 / (2 * of.depth), DEPTHS)
    tensors = (
        torch.from_numpy(part).float()
        for part in (of.grey, of.valid, np.tile(K, (VIEWS, 1, 1)), of.poses)
    )
    depth, cost = swept_depth(*tensors, 0, [1, 2, 3], tried)
    return depth.numpy(), cost.numpy()


def plainly(of: Photos) -> np.ndarray:
    """The tried depth of the least squared difference of single pixels."""
    tried = 1 / torch.linspace(1 / (0.5 * of.depth), 1 / (2 * of.depth), DEPTHS)
    grey, directions, costs = (
        torch.from_numpy(of.grey),
        rays(torch.from_numpy(K).float(), HEIGHT, WIDTH),
        [],
    )
    for z in tried:
        cost = torch.zeros(HEIGHT, WIDTH)
        for other in (1, 2, 3):
            between = torch.from_numpy(of.poses[other] @ np.linalg.inv(of.poses[0])).float()
            x, y, depth = torch.from_numpy(K).float() @ (
                between[:3, :3] @ directions * z + between[:3, 3:]
            )
            place = torch.stack(
                [x / depth / WIDTH * 2 - 1, y / depth / HEIGHT * 2 - 1], -1
            ).reshape(1, HEIGHT, WIDTH, 2)
            warped = torch.nn.functional.grid_sample(
                grey[None, None, other], place, align_corners=False
            )[0, 0]
            cost += (warped - grey[0]).square()
        costs.append(cost)
    return tried[torch.stack(costs).argmin(0)].numpy()


def off(ours: np.ndarray, exact: float) -> float:
    inner = np.abs(ours[INNER] / exact - 1)
    return float(np.median(inner)) if np.isfinite(inner).all() else float("inf")


WALLS: dict[str, Callable[[], Photos]] = {
    "as it is": photos,
    "in units of 1e-04": lambda: photos(1e-4),
    "in units of 1e+04": lambda: photos(1e4),
    "1e+02 from the origin": lambda: photos(shift=1e2),
    "two stops apart": lambda: lit(0, -2, -4, -6),
    "of a contrast of 1e-2": lambda: photos()._replace(
        grey=(0.5 + 1e-2 * (photos().grey - 0.5)).astype(np.float32)
    ),
    "one view of noise": lambda: photos()._replace(grey=_spoiled(photos().grey, 2)),
    "one view masked": lambda: photos()._replace(
        valid=np.where(np.arange(VIEWS)[:, None, None] == 2, 0, photos().valid)
    ),
    "one view at the same place": lambda: photos()._replace(poses=_moved(photos().poses, 2, 0.0)),
    "one view that looks away": lambda: photos()._replace(poses=_moved(photos().poses, 2, 1e3)),
}


def _spoiled(grey: np.ndarray, view: int) -> np.ndarray:
    noise = grey.copy()
    noise[view] = np.random.default_rng(1).random(grey.shape[1:])
    return noise


def _moved(poses: np.ndarray, view: int, place: float) -> np.ndarray:
    moved = poses.copy()
    moved[view, 0, 3] = -place
    return moved


@case("a wall {name}", name=WALLS)
def walls(name: str) -> Outcome:
    of = WALLS[name]()
    return beside(sweep(of)[0], lambda: plainly(of), of.depth, DEPTH, off)


BLIND: dict[str, Callable[[], Photos]] = {
    "no view counts": lambda: photos()._replace(valid=0 * photos().valid),
    "views that see nothing of it": lambda: photos()._replace(poses=_away(photos().poses)),
    "photos of 0": lambda: photos()._replace(grey=0 * photos().grey),
    "photos of 1": lambda: photos()._replace(grey=0 * photos().grey + 1),
}


def _away(poses: np.ndarray) -> np.ndarray:
    turned = poses.copy()
    turned[1:] = np.diag([-1.0, 1, -1, 1]) @ turned[1:]
    return turned


@case("{name}", name=BLIND)
def blind(name: str) -> Outcome:
    """Share of pixels whose depth is not among those that were tried, or whose cost is wrong: all
    alike, and far above what counts where nothing is seen.
    """
    of = BLIND[name]()
    depth, cost = sweep(of)
    wrong = ~((depth > 0.49 * of.depth) & (depth < 2.01 * of.depth)) | ~np.isfinite(cost)
    if "photos" not in name:
        wrong |= cost < 3.9
    return Outcome(float(wrong.mean()), 0.0)


def depths(unit: float = 1.0, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [V, H, W] of a wall, poses, and which views each is compared with."""
    of = photos(unit, shift)
    others = np.array([[k for k in range(VIEWS) if k != view] for view in range(VIEWS)])
    return np.full((VIEWS, HEIGHT, WIDTH), of.depth, np.float32), of.poses, others


AGREE: dict[str, Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray, bool]]] = {
    "in units of 1e-06": lambda: (*depths(1e-6), True),
    "in units of 1e+06": lambda: (*depths(1e6), True),
    "1e+04 from the origin": lambda: (*depths(shift=1e4), True),
    "of which one view knows nothing": lambda: (*_with(2, 0.0), True),
    "of which one view has NaN": lambda: (*_with(2, np.nan), True),
    "of which one view has inf": lambda: (*_with(2, np.inf), True),
    "of which one view has 1e+30": lambda: (*_with(2, 1e30), True),
    "through which two views of three see": lambda: (*_with(slice(2, 4), 9.0), False),
    "compared with no view": lambda: (*depths()[:2], np.full((VIEWS, 3), -1), False),
    "known to one view": lambda: (*_with(slice(1, 4), 0.0), False),
}


def _with(views: int | slice, value: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    depth, poses, others = depths()
    depth[views] = value
    return depth, poses, others


@case("agreement on a wall {name}", name=AGREE)
def agreement(name: str) -> Outcome:
    """The first view's depth if others confirm it, else 0; the plain way takes the mean of all."""
    depth, poses, others, confirmed = AGREE[name]()
    exact = (depth[0] * confirmed)[INNER]
    ours = agreed(depth, np.tile(K, (VIEWS, 1, 1)), poses, others, 2)
    return beside(ours[0][INNER], lambda: depth.mean(0)[INNER], exact, 1e-5, relative)
