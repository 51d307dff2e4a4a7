"""Which depths of a photo other photos confirm, and which they see through."""

from __future__ import annotations

import numpy as np

from chebsplat.kernels.jit import kernel, prange

SAME, THROUGH = 0.03, 0.05  # of a point's depth: what differs by less confirms it, what lies farther by more denies it
DENIED = 0.5  # views that may deny a point, for each that confirms it


def agreed(depth: np.ndarray, Ks: np.ndarray, poses: np.ndarray, others: np.ndarray, least: int) -> np.ndarray:
    """Depth f32 [V, h, w] that others agree on: the mean of what they and the view itself have; 0 elsewhere.

    Args: depth [V, h, w], 0 where none is known; Ks [V, 3, 3] in its pixels; cam_from_world [V, 4, 4];
          others i64 [V, M]: the views that each is compared with, -1: none; least: of them that must confirm a pixel.
    Choices: a view denies a point where it sees farther than that: nothing can be there. What a view sees before a
      point hides it, and says nothing.
    """
    rotations, eyes = poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3:]
    to_world = np.concatenate([rotations @ np.linalg.inv(Ks), -rotations @ eyes], 2)
    into = Ks @ poses[:, :3]
    return np.asarray(_agreed(np.ascontiguousarray(depth, np.float32), to_world, into, others, least))


@kernel
def _agreed(depth, to_world, into, others, least):
    n_views, height, width = depth.shape
    result = np.zeros_like(depth)
    for view in prange(n_views):
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
    return result
