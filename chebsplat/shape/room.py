"""A room by its surfaces: their three dominant normals, up, and the sides that it has."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

# directions, surfaces that try them; cosine of 11 degrees
N_TRIED, N_PLANES, PARALLEL = 400, 20_000, 0.98
SQUARE = 0.2  # cosine, of directions at right angles
FREE, SEATS = 0.1, 0.23  # of a room's extent: off its walls; off floor and ceiling
LEAST_BOXED = 0.35  # of the shares of `room_axes`: 26 rooms have .45 at least, 12 other scenes .27
LEVEL = 0.95  # cosine of a level surface's normal to up
# of a room's longest side: a cell of its sides, and how far from one a surface belongs to it
CELL, NEAR = 1 / 48, 1 / 32
OUTMOST = 0.005  # part of the points that may lie beyond a side
N_ABOUT = 32  # points whose colour a cell takes


def room_axes(normals: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """The three dominant normals of a surface, about at right angles, unit [3, 3], and the share of
    the surface that faces along each.

    Args: normals [N, 3] unit, of any sign; weights [N], of the surface that each stands for.
    Choices: directions are tried at the normals of N_TRIED surfaces.
    """
    rng = np.random.default_rng(0)
    share = weights / weights.sum()
    tried = normals[rng.choice(len(normals), N_TRIED, p=share)]
    drawn = normals[rng.choice(len(normals), min(len(normals), N_PLANES), p=share)]
    across = (np.abs(tried @ drawn.T) > PARALLEL).mean(1)
    axes, shares = [], []
    for _ in range(3):
        best = int(across.argmax())
        shares.append(float(across[best]))
        axis: np.ndarray = tried[best].astype(np.float64)
        across[np.abs(tried @ tried[best]) > SQUARE] = 0
        for _ in range(3):  # the mean of what is parallel to it, of either sign
            here = np.abs(normals @ axis) > PARALLEL
            axis = np.linalg.eigh((normals[here] * weights[here, None]).T @ normals[here])[1][:, -1]
        axes.append(axis)
    return np.stack(axes), shares


def room_up(
    means: np.ndarray, normals: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Up, unit [3], of the Gaussians of a room without cameras, and two signs that it is a room.

    Args: means [N, 3]; normals [N, 3] unit, of any sign; weights [N], of the flat surface that each
      stands for.
    Returns: up; the share of the surface that lies across three directions at right angles; the
      lean: in [0, 1], 0 where nothing tells up from down.
    Choices: a room's directions are those that most of its surface lies across; along up, what
      stands free of floor, ceiling and walls lies low, and so do level surfaces between floor and
      ceiling (SEATS), without lamps and beams.
    """
    axes, shares = room_axes(normals, weights)
    share, heights = weights / weights.sum(), []
    for axis in axes:
        low, high = np.quantile(means @ axis, (0.02, 0.98))
        heights.append((means @ axis - low) / max(high - low, 1e-30))
    free = np.all([(h > FREE) & (h < 1 - FREE) for h in heights], 0)
    leans = [lean(share, h, free) for h in heights]
    best = int(np.argmax([s * (1 + 2 * of**2) for s, of in zip(shares, leans, strict=True)]))
    up, height = axes[best], heights[best]
    level = (np.abs(normals @ up) > LEVEL) & (height > SEATS) & (height < 1 - SEATS)
    down = (leans[best] + lean(share, height, level)) / 2
    return (up if down >= 0 else -up), sum(shares), abs(down)


def lean(share: np.ndarray, height: np.ndarray, mask: np.ndarray) -> float:
    """The part of the masked surface in the lower half less that in the upper one, in [-1, 1];
    share [N]: of all surface that each Gaussian has.
    """
    total = float(share[mask].sum())
    return (2 * float(share[mask & (height < 0.5)].sum()) - total) / max(total, 1e-30)


def sides_of(
    means: np.ndarray, normals: np.ndarray, colors: np.ndarray, axes: np.ndarray, eyes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The sides of a room that its surfaces show in part, as points [M, 3], one a cell, with
    colours u8 [M, 3].

    Args: means [N, 3]; normals [N, 3] unit, of any sign; colors u8 [N, 3]: of its surfaces; axes:
      by `room_axes`, the strongest first; eyes [V, 3] of its cameras.
    Choices: the second axis is made perpendicular to the first, the third to both. A side lies
      where the outmost points end that face along an axis (OUTMOST of them lie beyond); it needs
      N_ABOUT of them, and every camera inside. Sides reach to one another, or as far as points and
      cameras do. A cell has the median colour of the N_ABOUT nearest points of its side: what
      stands or hangs in one place colours little.
    """
    third = np.cross(axes[0], axes[1])
    frame = np.stack([axes[0], np.cross(third, axes[0]), third])
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    local, cameras = means @ frame.T, eyes @ frame.T
    low, high = np.quantile(local, (OUTMOST, 1 - OUTMOST), axis=0)
    near = NEAR * float((high - low).max())
    sides = []
    for axis in range(3):
        facing = np.abs(normals @ frame[axis]) > PARALLEL
        for bounds, inward in ((low, 1), (high, -1)):
            rows = np.flatnonzero(facing & (np.abs(local[:, axis] - bounds[axis]) < near))
            if len(rows) >= N_ABOUT:
                offset = float(np.median(local[rows, axis]))
                if (inward * (cameras[:, axis] - offset) > 0).all():
                    sides.append((axis, offset, rows))
    low, high = np.minimum(low, cameras.min(0)), np.maximum(high, cameras.max(0))
    edge = CELL * float((high - low).max())
    points, about = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for axis, offset, rows in sides:
        others = [k for k in range(3) if k != axis]
        middles = [np.arange(low[k] + edge / 2, high[k], edge) for k in others]
        grid = np.stack(np.meshgrid(*middles, indexing="ij"), -1).reshape(-1, 2)
        points.append(np.insert(grid, axis, offset, axis=1))
        nearest = cKDTree(local[rows][:, others]).query(grid, N_ABOUT)[1]
        about.append(np.median(colors[rows[nearest]], axis=1))
    return np.concatenate(points) @ frame, np.concatenate(about).round().astype(np.uint8)
