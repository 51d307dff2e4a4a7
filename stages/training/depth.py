"""Depth that a capture brings, or a sweep of its photos has found: whether a training relies on it, how it is read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from chebsplat.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points
    from chebsplat.settings import TrainSection

WEIGHT = 0.8  # of the depth loss, where the config leaves it open
MOST_APART = 0.003  # of its depth, where views still tell the same of a point
N_PAIRS, N_PIXELS = 100, 1000  # views that are compared, and pixels of each
SAME = 0.1  # of its depth, beyond which what one view sees is hidden from the other
MEMORY = 512 << 20  # bytes of depth that are kept


def with_depth_loss(train: TrainSection, capture: Capture, points: Points) -> tuple[TrainSection, str]:
    """The section with its depth loss decided where the config leaves it open, and why there is none ("": there is).

    Choices: none if the capture has no poses, since its unit is not the scene's then, or if its views contradict one
      another, as a sensor's do: its noise and its place beside the colour camera would be taught. Swept depth is only
      where views agree.
    """
    if train.weight_depth is not None:
        return train, "" if train.weight_depth else "train.weight_depth is 0"
    if capture.depth is None and points.depths is not None:
        return train.model_copy(update={"weight_depth": WEIGHT}), ""
    if capture.depth is None or capture.cam_from_world is None:
        return train.model_copy(update={"weight_depth": 0.0}), "the capture has no depth in the unit of its poses"
    apart = disagreement(capture, points)
    if apart > MOST_APART:
        why = f"depths of the same points differ by {apart:.1%} between views; train.weight_depth asks for it"
        return train.model_copy(update={"weight_depth": 0.0}), why
    return train.model_copy(update={"weight_depth": WEIGHT}), ""


def disagreement(capture: Capture, points: Points) -> float:
    """Median over points of |z' / z - 1|, z' from one training view's depth and z what another sees there; 0 if no two
    views see a point in common, or there are none.
    """
    import numpy as np

    from chebsplat.cameras import unproject

    assert capture.depth is not None
    row, rng = {name: view for view, name in enumerate(capture.names)}, np.random.default_rng(0)
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    differences = [np.zeros(0)]
    for a, b in rng.choice(used, (N_PAIRS, 2)) if used else ():
        one, other = (np.asarray(capture.depth[row[points.names[view]]]) for view in (a, b))
        pixels = np.stack([rng.integers(0, side, N_PIXELS) for side in one.shape], 1)
        pixels = pixels[one[pixels[:, 0], pixels[:, 1]] > 0]  # nan is none
        world = unproject(one, points.Ks[a], points.cam_from_world[a], pixels)
        seen = (world @ points.cam_from_world[b, :3, :3].T + points.cam_from_world[b, :3, 3]) @ points.Ks[b].T
        seen = seen[seen[:, 2] > 0]
        column, line = (np.floor(seen[:, axis] / seen[:, 2]) for axis in (0, 1))
        inside = (column >= 0) & (column < other.shape[1]) & (line >= 0) & (line < other.shape[0])
        there = other[line[inside].astype(int), column[inside].astype(int)]
        known = there > 0
        apart = np.abs(seen[inside, 2][known] / there[known] - 1)
        if a != b:
            differences.append(apart[apart < SAME])
    every = np.concatenate(differences)
    return float(np.median(every)) if len(every) else 0.0


def measured_depth(capture: Capture, points: Points, used: list[int]) -> Callable[[int, int], Tensor]:
    """z-depth, every so many pixels, of the views of the points that have these indices: the capture's, otherwise what
    was swept, 0 where neither tells.

    Raises: ConfigError where there is none, or where its unit is not the scene's, as poses are not the capture's own.
    """
    import torch

    from chebsplat.views import remembered

    depth, swept, (width, height) = capture.depth, points.depths, capture.size
    if depth is not None and capture.cam_from_world is not None:
        row = {name: view for view, name in enumerate(capture.names)}
        read = remembered(lambda index: torch.from_numpy(depth[row[points.names[used[index]]]]), MEMORY)
    elif swept is not None:
        factor = width // swept.shape[2]  # of the blocks of pixels that a swept one stands for

        def read(index: int) -> Tensor:
            blocks = torch.from_numpy(swept[used[index]]).repeat_interleave(factor, 0).repeat_interleave(factor, 1)
            whole = torch.zeros(height, width)
            whole[: len(blocks), : blocks.shape[1]] = blocks
            return whole

    else:
        raise ConfigError(
            "train.weight_depth needs a capture with poses and depth, and this one has no depth; set it to 0, or sweep "
            "the photos for it (sfm.dense=on)"
        )

    def at(index: int, factor: int) -> Tensor:
        rows, columns = (side // factor * factor for side in (height, width))
        return read(index)[:rows:factor, :columns:factor]

    return at
