"""Compositing, tile by tile, for one view and float32; its adjoint is `tiles_adjoint`.

A tile of 16×16 pixels is 16 cells of 4×4 (see `cells`). Forward tests a tile's Gaussians against
all its cells at once, in chunks until every pixel is done, then sweeps cell by cell. Backward
repeats the sweep, so that only the cells' bit masks are kept between the two.

Channels come in two kinds: `colors` by pixel, and `cell_colors`, of which only the mean over each
cell of 4×4 pixels is rendered. A Gaussian's part in that mean is the sum of its 16 weights, so a
cell channel costs a sixteenth of the products of the other kind, forward and backward.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import kernel, plain, serial
from chebsplat.kernels.threads import in_every_thread, in_parts
from chebsplat.rasterize import cells
from chebsplat.rasterize.binning import TILE
from chebsplat.rasterize.blocks import claim, from_lanes, prefetch
from chebsplat.rasterize.cells import LANES, ONE, SHAPE, SLACK

AHEAD_OF_CACHE = 16  # rows between asking for one and using it
CHUNK = 128  # Gaussians of a tile between two looks at whether it is done


@plain
def cell_column(channels):
    """First column of a splat's cell channels, behind its shape, its channels and alpha's 1."""
    return cells.whole(SHAPE + channels + 1)


@kernel
def _pack(first, last, order, means2d, whitening, opacities, colors, cell_colors, splats):
    channels, column = colors.shape[1], cell_column(colors.shape[1])
    for m in range(first, last):
        i = order[m]
        splats[m, 0], splats[m, 1] = means2d[i, 0], means2d[i, 1]
        splats[m, 2], splats[m, 3], splats[m, 4] = whitening[i, 0], whitening[i, 1], whitening[i, 2]
        splats[m, 5] = math.log2(opacities[i])
        for d in range(channels):
            splats[m, SHAPE + d] = colors[i, d]
        splats[m, SHAPE + channels] = ONE
        for d in range(cell_colors.shape[1]):
            splats[m, column + d] = cell_colors[i, d]


def pack(order, means2d, whitening, opacities, colors, cell_colors) -> np.ndarray:
    """Rows of whole cache lines that the tiles read, one for each Gaussian, front to back.

    Returns: splats [V + 1, S]: mean, whitening, log₂ opacity, two unused, the channels, a 1 for
      alpha, zeros, and from `cell_column` on the cell channels and zeros.
    """
    width = cell_column(colors.shape[1]) + cells.whole(cell_colors.shape[1])
    splats = np.zeros((len(order) + 1, width), np.float32)
    in_parts(_pack, len(order), order, means2d, whitening, opacities, colors, cell_colors, splats)
    return splats


@serial
def fill_shapes(splats, ranks, start, n, left, top, shapes):
    """Fill the tile's rows of shapes (see `cells`), up to SLACK more, with channels as they fit."""
    stop, step, depth = len(ranks) - 1, splats.shape[1], shapes.shape[1] - SHAPE
    for k in range(n):
        following = np.int64(ranks[min(start + k + AHEAD_OF_CACHE, stop)]) * step
        for d in range(0, step, LANES):
            prefetch(splats, following + d)
        m = ranks[start + k]
        p, q, r = splats[m, 2], splats[m, 3], splats[m, 4]
        dx, dy = (
            np.float32(left + TILE // 2) - splats[m, 0],
            np.float32(top + TILE // 2) - splats[m, 1],
        )
        shapes[k, 0], shapes[k, 1], shapes[k, 2] = p, q, r
        shapes[k, 3], shapes[k, 4], shapes[k, 5] = p * dx + q * dy, r * dy, splats[m, 5]
        cells.copy_whole(
            splats, np.int64(m) * step + SHAPE, depth, shapes, k * shapes.shape[1] + SHAPE
        )


@serial
def n_pixels_inside(cell, width, height):
    """Pixels of a cell in an image that ends `width` × `height` pixels from its tile's corner."""
    x, y = 4 * (cell & 3), 4 * (cell >> 2)
    return max(min(4, width - x), 0) * max(min(4, height - y), 0)


@serial
def _forward_tile(
    splats, ranks, start, stop, left, top, width, height, channels, max_alpha, masks,
    render, means, transmittance,
):  # fmt: skip
    """One tile of `forward`, into flat render and transmittance. Returns the pairs looked at."""
    states, depth = np.empty((LANES, 2, LANES), np.float32), cells.padded(channels)
    cells.begin(states, width - left, height - top)
    sums, column = np.zeros((LANES, depth, LANES), np.float32), cell_column(channels)
    mean_sums, shares = (
        np.zeros((LANES, splats.shape[1] - column), np.float32),
        np.empty(CHUNK, np.float32),
    )
    shapes = np.empty((CHUNK + SLACK, SHAPE + depth), np.float32)
    alphas, weights = np.empty((CHUNK, LANES), np.float32), np.empty((CHUNK, LANES), np.float32)
    hits, rows = np.empty(CHUNK + LANES, np.uint32), np.empty(CHUNK, np.uint32)
    is_done, n_done, first = np.zeros(LANES, np.bool_), 0, start
    while n_done < LANES and first < stop:
        n = min(CHUNK, stop - first)
        fill_shapes(splats, ranks, first, n, left, top, shapes)
        for k in range(n):
            masks[first + k] = cells.reach(shapes, k)
        for cell in range(LANES):
            if is_done[cell]:
                continue
            count = cells.listed(masks, first, n, cell, hits)
            count = cells.sweep(shapes, hits, count, cell, max_alpha, states, alphas, weights, rows)
            if count > 0:
                cells.accumulate(shapes, rows, weights, count, cell, sums)
                if means.shape[2] > 0:
                    cells.sum_lanes(weights, count, shares)
                    cells.accumulate_means(
                        splats, column, ranks, first, rows, shares, count, cell, mean_sums
                    )
            is_done[cell] = cells.is_done(states, cell)
            n_done += is_done[cell]
        first += n
    pixels = np.empty(LANES * channels + LANES, np.float32)
    for cell in range(LANES):
        x, y = cells.corner(cell)
        x, y = left + x, top + y
        n = min(4, width - x)
        if n <= 0 or y >= height:
            continue
        # what the last four spill into the next pixel, the first four mend
        for c in range(depth - 4, -1, -4):
            from_lanes(pixels, c, channels, sums, LANES * (cell * depth + c))
        for row in range(min(4, height - y)):
            cells.copy(states, 2 * LANES * cell + 4 * row, n, transmittance, (y + row) * width + x)
            cells.copy(
                pixels, 4 * row * channels, n * channels, render, ((y + row) * width + x) * channels
            )
    for cell in range(LANES):
        n_inside = n_pixels_inside(cell, width - left, height - top)
        if n_inside > 0:
            x, y = left // 4 + (cell & 3), top // 4 + (cell >> 2)
            for c in range(means.shape[2]):
                means[y, x, c] = mean_sums[cell, c] / np.float32(n_inside)
    return first - start


@kernel
def _forward(
    queue, splats, tile_starts, ranks, channels, width, height, max_alpha, masks, used, render,
    means, transmittance,
):  # fmt: skip
    columns, n_tiles = (width + TILE - 1) // TILE, len(used)
    tile = claim(queue)
    while tile < n_tiles:
        used[tile] = _forward_tile(
            splats, ranks, tile_starts[tile], tile_starts[tile + 1],
            (tile % columns) * TILE, (tile // columns) * TILE, width, height, channels,
            max_alpha, masks, render, means, transmittance,
        )  # fmt: skip
        tile = claim(queue)


def forward(
    splats, tile_starts, ranks, channels, cell_channels, width, height, max_alpha,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Composite front to back the splats of `pack`, listed by `binning.bin_gaussians`.

    Returns: render [H, W, D], means [⌈H/4⌉, ⌈W/4⌉, E] over the cells, transmittance [H, W]; masks
      u16 [P + 16] of the cells each pair may reach, and used [tiles], the pairs that were looked at
      before all pixels were done: for `backward`.
    """
    render = np.empty(height * width * channels, np.float32)
    means = np.empty(((height + 3) // 4, (width + 3) // 4, cell_channels), np.float32)
    transmittance = np.empty(height * width, np.float32)
    masks = np.empty(len(ranks) + LANES, np.uint16)
    used = np.zeros(len(tile_starts) - 1, np.int64)
    in_every_thread(
        _forward, np.zeros(1, np.int64), splats, tile_starts, ranks, channels, width, height,
        max_alpha, masks, used, render, means, transmittance,
    )  # fmt: skip
    shape = height, width
    return render.reshape((*shape, channels)), means, transmittance.reshape(shape), masks, used
