"""Binning of Gaussians to the tiles that they touch, front to back.

A Gaussian touches a tile through one *pair*. Pairs are numbered by band of tile rows, then Gaussian
by Gaussian: the gradient records that a Gaussian collects in a band lie together and are summed in
a fixed order. No atomics, the same bits for any number of threads, and records for one band at a
time. Work is dealt out in PARTS, whatever the threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from chebsplat.kernels.jit import body, kernel, plain, serial
from chebsplat.kernels.threads import in_parts

TILE = 16
BANDS = 4  # at most; of tile rows
PARTS = 16
ALPHA_MIN = 1 / 255
DIGIT = 11  # bits of a sorting pass: three passes for 32


class Bins(NamedTuple):
    """order i32 [V]: the Gaussians that touch a tile, front to back; their position in it is their
    *rank*. tile_starts i64 [tiles + 1] and, in tile order and front to back within, rank and pair,
    i32 [P]; pair_starts i32 [bands, V + 1] by rank.
    """

    order: np.ndarray
    tile_starts: np.ndarray
    rank: np.ndarray
    pair: np.ndarray
    pair_starts: np.ndarray


@body
def _share(part, n):
    """First index of a part of n."""
    return part * n // PARTS


@plain
def band_start(band, rows):
    """First tile row of a band."""
    return band * rows // min(BANDS, rows)


@body
def _box(means2d, covariances, opacities, i, width, height, boxes):
    """Fill the half-open box of tiles that α ≥ 1/255 may touch, x then y."""
    limit = 2.0 * math.log(255.0 * opacities[i]) + 1e-3  # the cells' own test is exact
    reach_x, reach_y = math.sqrt(limit * covariances[i, 0]), math.sqrt(limit * covariances[i, 2])
    # a pixel's centre is at +0.5
    x0, x1 = (
        max(means2d[i, 0] - reach_x - 0.5, 0.0),
        min(means2d[i, 0] + reach_x + 0.5, float(width)),
    )
    y0, y1 = (
        max(means2d[i, 1] - reach_y - 0.5, 0.0),
        min(means2d[i, 1] + reach_y + 0.5, float(height)),
    )
    if x0 < x1 and y0 < y1:
        boxes[i, 0], boxes[i, 1] = int(x0) // TILE, (math.ceil(x1) + TILE - 1) // TILE
        boxes[i, 2], boxes[i, 3] = int(y0) // TILE, (math.ceil(y1) + TILE - 1) // TILE


@body
def _usable(radii, opacities, colors, cell_colors, i):
    """Projected, bright enough, and finite in opacity and in every channel."""
    check = np.float32(0)
    for d in range(colors.shape[1]):
        check += colors[i, d] * np.float32(0)
    for d in range(cell_colors.shape[1]):
        check += cell_colors[i, d] * np.float32(0)
    return (
        radii[i] != 0
        and opacities[i] >= np.float32(ALPHA_MIN)
        and math.isfinite(opacities[i])
        and check == 0
    )


@serial
def _sort(index, keys):
    """`index` by ascending key, ties as they come: a radix sort, fastest on one thread."""
    n, size = len(index), 1 << DIGIT
    other_index, other_keys = np.empty_like(index), np.empty_like(keys)
    mask = np.uint32(size - 1)
    for k in range(3):
        shift, starts = np.uint32(k * DIGIT), np.zeros(size + 1, np.int64)
        for m in range(n):
            starts[((keys[m] >> shift) & mask) + 1] += 1
        for digit in range(size):
            starts[digit + 1] += starts[digit]
        for m in range(n):
            digit = (keys[m] >> shift) & mask
            where = starts[digit]
            other_index[where], other_keys[where] = index[m], keys[m]
            starts[digit] = where + 1
        index, other_index = other_index, index
        keys, other_keys = other_keys, keys
    return index


@kernel
def _fill_boxes(
    first, last, means2d, covariances, radii, opacities, colors, cell_colors, width, height, boxes
):  # fmt: skip
    """Boxes of tiles i32 [N, 4], all 0 before, of the Gaussians that touch one."""
    for i in range(first, last):
        if _usable(radii, opacities, colors, cell_colors, i):
            _box(means2d, covariances, opacities, i, width, height, boxes)


@serial
def _depth_keys(boxes, depths):
    """Indices of the Gaussians that touch a tile; their depths, positive, as keys of that order."""
    index, keys, bits = (
        np.empty(len(boxes), np.int32),
        np.empty(len(boxes), np.uint32),
        depths.view(np.uint32),
    )
    n = 0
    for i in range(len(boxes)):
        index[n], keys[n] = i, bits[i]
        n += boxes[i, 1] > 0
    return index[:n], keys[:n]


@kernel
def _count(first, last, order, boxes, band_of, columns, cursors, pair_starts):
    """Pairs of each tile by part in `cursors`, and of each Gaussian by band in `pair_starts`."""
    n = len(order)
    for part in range(first, last):
        for m in range(_share(part, n), _share(part + 1, n)):
            x0, x1, y0, y1 = (
                boxes[order[m], 0],
                boxes[order[m], 1],
                boxes[order[m], 2],
                boxes[order[m], 3],
            )
            for y in range(y0, y1):
                pair_starts[band_of[y], m + 1] += x1 - x0
                for x in range(x0, x1):
                    cursors[part, y * columns + x] += 1


@serial
def _add_up(cursors, pair_starts, tile_starts):
    """Numbers of pairs become where each tile's begin, and each Gaussian's in a band."""
    total = np.int32(0)
    for band in range(len(pair_starts)):
        pair_starts[band, 0] = total
        for m in range(pair_starts.shape[1] - 1):
            total += pair_starts[band, m + 1]
            pair_starts[band, m + 1] = total
    total = np.int32(0)
    for tile in range(cursors.shape[1]):
        for part in range(PARTS):
            count = cursors[part, tile]
            cursors[part, tile] = total
            total += count
        tile_starts[tile + 1] = total


@kernel
def _deal(first, last, order, boxes, band_of, columns, pair_starts, cursors, rank, pair):
    """Rank and pair of every Gaussian, in this order, at its tiles' cursors, which move on."""
    n = len(order)
    for part in range(first, last):
        for m in range(_share(part, n), _share(part + 1, n)):
            x0, x1, y0, y1 = (
                boxes[order[m], 0],
                boxes[order[m], 1],
                boxes[order[m], 2],
                boxes[order[m], 3],
            )
            band, k = -1, 0
            for y in range(y0, y1):
                if band_of[y] != band:
                    band = band_of[y]
                    k = pair_starts[band, m]
                for x in range(x0, x1):
                    where = cursors[part, y * columns + x]
                    rank[where], pair[where] = m, k
                    cursors[part, y * columns + x] = where + 1
                    k += 1


def bin_gaussians(
    means2d: np.ndarray, covariances: np.ndarray, depths: np.ndarray, radii: np.ndarray,
    opacities: np.ndarray, colors: np.ndarray, cell_colors: np.ndarray, width: int, height: int,
) -> Bins:  # fmt: skip
    """Pairs of Gaussians and tiles of one view.

    Args: as `ellipses.project` gives them; opacities [N]; colors [N, D], cell_colors [N, E].
    Choices: the box of the ellipse α ≥ 1/255; a Gaussian that is fainter, or not finite in opacity
      or in any channel, touches nothing. Ties in depth go by index.
    """
    boxes = np.zeros((len(means2d), 4), np.int32)
    in_parts(_fill_boxes, len(boxes), means2d, covariances, radii, opacities, colors, cell_colors,
             width, height, boxes)  # fmt: skip
    order = _sort(*_depth_keys(boxes, depths))
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    bands = min(BANDS, rows)
    band_of = (np.arange(1, rows + 1) * bands - 1) // rows  # the last that starts there or before
    cursors = np.zeros((PARTS, columns * rows), np.int32)
    pair_starts = np.zeros((bands, len(order) + 1), np.int32)
    tile_starts = np.zeros(columns * rows + 1, np.int64)
    in_parts(_count, PARTS, order, boxes, band_of, columns, cursors, pair_starts)
    _add_up(cursors, pair_starts, tile_starts)
    rank, pair = np.empty((2, tile_starts[-1]), np.int32)
    in_parts(_deal, PARTS, order, boxes, band_of, columns, pair_starts, cursors, rank, pair)
    return Bins(order, tile_starts, rank, pair, pair_starts)
