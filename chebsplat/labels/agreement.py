"""Agreement of views on the same points: a figure of a 2D teacher that needs no true labels.

A pixel (u, v) has its centre at half integers; poses are OpenCV's, points in the world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

UNSEEN = -1
SLACK = 0.03  # of the depth: how far off the surface a point may seem to lie
COARSE = 8  # pixels of a cell in which the nearest point hides others
COARSE_SLACK = 0.1  # of the depth: a surface may slope within a cell
BLOCK = 256  # points whose pairs of views are looked at together


class Agreement(NamedTuple):
    """value: 1 if views always agree, 0 if by chance alone, nan where no point has two labels.

    share f64 [L]: of the views' labels; by_label f64 [L]: each label's own agreement, nan where it
      does not occur.
    """

    value: float
    share: np.ndarray
    by_label: np.ndarray


def project(
    points: np.ndarray, K: np.ndarray, cam_from_world: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Columns u, v in pixels and depth z, f64 [N, 3], of points [N, 3] in a view of `size` (W, H).

    Returns: nan where a point lies outside the view or behind it.
    """
    camera = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    z = camera[:, 2]
    ahead = z > 1e-6
    image = camera / np.where(ahead, z, 1.0)[:, None] @ K.T
    image[:, 2] = z
    inside = ahead & (image[:, :2] >= 0).all(1) & (image[:, :2] < size).all(1)
    return np.where(inside[:, None], image, np.nan)


def unhidden(
    image: np.ndarray, size: tuple[int, int], depth: np.ndarray | None = None
) -> np.ndarray:
    """True for projected points [N, 3] that no surface hides, bool [N].

    Args: depth: [H, W] z-depth of the view, nan where unknown, or None.
    Choices: without depth the nearest point of a cell of 8 pixels, and of the cells about it,
      stands for the surface; a floor that is seen from above hides little of itself, and what few
      points are on hides little behind it.
    """
    inside = np.isfinite(image[:, 0])
    columns, rows = (np.where(inside, image[:, k], 0).astype(np.int64) for k in (0, 1))
    if depth is not None:
        surface = depth[rows, columns]
        return np.asarray(inside & (np.abs(image[:, 2] - surface) < SLACK * surface))
    shape = (-(-size[1] // COARSE) + 2, -(-size[0] // COARSE) + 2)
    nearest = np.full(shape, np.inf)
    np.minimum.at(
        nearest, (rows[inside] // COARSE + 1, columns[inside] // COARSE + 1), image[inside, 2]
    )
    about = np.lib.stride_tricks.sliding_window_view(nearest, (3, 3)).min((2, 3))
    limits = (1 + COARSE_SLACK) * about[rows // COARSE, columns // COARSE]
    visible: np.ndarray = inside & (np.where(inside, image[:, 2], np.inf) < limits)
    return visible


def far_pairs(points: np.ndarray, eyes: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """The two views that see each point from the most different places.

    Args: points [N, 3]; eyes [V, 3] of the views; visible bool [N, V].
    Returns: i64 [M, 3] (point, view, view) of the points that two views see.
    Choices: the difference of two places is the angle between them at the point, in units of 30°,
      and the logarithm of the ratio of their distances. Two photos that look alike are taken for
      the same thing even by a teacher that is wrong; from another side it errs in another way.
    """
    pairs = [np.zeros((0, 3), np.int64)]
    for start in range(0, len(points), BLOCK):
        rays = eyes - points[start : start + BLOCK, None]
        lengths = np.linalg.norm(rays, axis=2).clip(1e-12)
        unit, scale = rays / lengths[..., None], np.log(lengths)
        angles = np.arccos(np.clip(unit @ unit.transpose(0, 2, 1), -1, 1)) / (np.pi / 6)
        apart = angles + np.abs(scale[:, :, None] - scale[:, None])
        both = visible[start : start + BLOCK, :, None] & visible[start : start + BLOCK, None]
        both[:, np.arange(len(eyes)), np.arange(len(eyes))] = False
        best = np.where(both, apart, -1.0).reshape(len(rays), -1).argmax(1)
        views = np.stack(np.divmod(best, len(eyes)), 1)
        rows = np.flatnonzero(both.any((1, 2)))
        pairs.append(np.concatenate([rows[:, None] + start, views[rows]], 1))
    return np.concatenate(pairs)


def between(first: np.ndarray, second: np.ndarray, n_labels: int) -> Agreement:
    """Agreement of two views on M points: mean over labels of a chance-corrected IoU.

    Args: first, second: i64 [M], labels in 0...n_labels-1 of the two views of each point.
    Choices: a label's IoU of points (in both views / in either) rises with the true mIoU, needs no
      true labels, and is as balanced over labels: a teacher that calls everything wall has nothing
      to disagree on, and one label. Two views that give a label independently, with its share p,
      have an IoU of p / (2 - p): 0 on the scale of (IoU - chance) / (1 - chance), so that the label
      that is everywhere counts nothing. Where a single label is said its chance is 1, and its
      agreement 0. The two views of a point are exchangeable.
    Source: Cohen's correction for chance (1960), of the IoU.
    """
    counts = np.bincount(first * n_labels + second, minlength=n_labels**2).reshape(
        n_labels, n_labels
    )
    both = 2.0 * np.diag(counts)
    votes = (counts.sum(0) + counts.sum(1)).astype(np.float64)
    share = votes / max(votes.sum(), 1)
    occurs = votes > 0
    chance = share / (2 - share)
    iou = np.divide(both, 2 * votes - both, out=np.zeros(n_labels), where=occurs)
    by_label = np.divide(iou - chance, 1 - chance, out=np.zeros(n_labels), where=chance < 1)
    by_label[~occurs] = np.nan
    return Agreement(
        float(by_label[occurs].mean()) if occurs.any() else float("nan"), share, by_label
    )
