"""Farthest points, compiled; `chebsplat/printed/regions.py` picks the same plainly."""

import numpy as np

from chebsplat.kernels.jit import serial

BLOCK = 128  # points that a pick passes over together


@serial
def pick_farthest(points, count, start):
    """Rows i64 [count] of points f32 [N, 3], each the farthest from those before it.

    Choices: neighbouring rows lie close together; a BLOCK of them that is farther from the last
      pick than any of its points from an earlier one is passed over, which rounding cannot change.
    """
    n_blocks = -(-len(points) // BLOCK)
    low, high = np.empty((n_blocks, 3), np.float32), np.empty((n_blocks, 3), np.float32)
    for block in range(n_blocks):
        for axis in range(3):
            own = points[block * BLOCK : (block + 1) * BLOCK, axis]
            low[block, axis], high[block, axis] = own.min(), own.max()
    distances = np.full(len(points), np.inf, np.float32)  # squares
    reach, farthest = np.full(n_blocks, np.inf, np.float32), np.zeros(n_blocks, np.int64)
    picked, last = np.empty(count, np.int64), start
    for k in range(count):
        picked[k] = last
        x, y, z = points[last]
        best = np.float32(-1)
        for block in range(n_blocks):
            dx = max(low[block, 0] - x, x - high[block, 0], np.float32(0))
            dy = max(low[block, 1] - y, y - high[block, 1], np.float32(0))
            dz = max(low[block, 2] - z, z - high[block, 2], np.float32(0))
            if dx * dx + dy * dy + dz * dz < reach[block]:
                reach[block] = -1
                for row in range(block * BLOCK, min((block + 1) * BLOCK, len(points))):
                    dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
                    distances[row] = min(distances[row], dx * dx + dy * dy + dz * dz)
                    if distances[row] > reach[block]:
                        reach[block], farthest[block] = distances[row], row
            if reach[block] > best:
                best, last = reach[block], farthest[block]
    return picked
