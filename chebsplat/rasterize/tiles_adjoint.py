"""The adjoint of compositing, tile by tile (see `tiles`): a tile fills the records of its pairs,
and every Gaussian's records are summed in the order of its pairs, so that gradients are the same
bits for any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from chebsplat.kernels.jit import kernel, serial
from chebsplat.kernels.threads import in_every_thread, in_parts
from chebsplat.rasterize import cell_adjoint, cells
from chebsplat.rasterize.binning import TILE, band_start
from chebsplat.rasterize.blocks import claim, prefetch, to_lanes
from chebsplat.rasterize.cells import BLOCK, LANES, N_GEOMETRY, SHAPE, SLACK
from chebsplat.rasterize.tiles import AHEAD_OF_CACHE, cell_column, fill_shapes, n_pixels_inside


@serial
def _backward_tile(
    splats, ranks, pair, masks, start, n, left, top, width, height, channels,
    max_alpha, grad, grad_means, grad_alpha, absolute, base, spare, records,
):  # fmt: skip
    """One tile of `backward`: adds to its pairs' records. Returns True for a finite gradient.

    `base` is the first pair's number, `spare` a row of records that takes what fills up a block.
    """
    depth = channels + 1  # alpha is a channel in which every Gaussian is 1
    states = np.empty((LANES, 2, LANES), np.float32)
    cells.begin(states, width - left, height - top)
    row, finite = LANES * channels + LANES, True  # of tall_grads: a cell's pixels, and a margin
    grads = np.empty((LANES, cells.padded(channels) + 4, LANES), np.float32)
    tall_grads, column = np.zeros(LANES * row, np.float32), cell_column(channels)
    mean_grads = np.zeros((LANES, splats.shape[1] - column), np.float32)
    for cell in range(LANES):
        x, y = cells.corner(cell)
        x, y, at, in_lanes = (
            left + x,
            top + y,
            cell * row,
            LANES * (grads.shape[1] * cell + channels),
        )
        n_wide = max(min(4, width - x), 0)
        for k in range(4):
            inside = n_wide if y + k < height else 0
            cells.copy(grad, ((y + k) * width + x) * channels, inside * channels, tall_grads, at)
            at += 4 * channels
        for c in range(0, channels, 4):
            to_lanes(
                grads, LANES * (grads.shape[1] * cell + c), tall_grads, cell * row + c, channels
            )
        for k in range(4):  # after `to_lanes`, whose last four channels may reach into this one
            inside = n_wide if y + k < height else 0
            cells.copy(grad_alpha, (y + k) * width + x, inside, grads, in_lanes + 4 * k)
            cells.clear(grads, in_lanes + 4 * k + inside, 4 - inside)
        finite &= cells.is_finite(tall_grads, cell * row, row)
        finite &= cells.is_finite(grads, in_lanes, LANES)
    for cell in range(LANES):
        n_inside = n_pixels_inside(cell, width - left, height - top)
        if n_inside > 0:
            x, y = left // 4 + (cell & 3), top // 4 + (cell >> 2)
            for c in range(grad_means.shape[2]):
                mean_grads[cell, c] = grad_means[y, x, c] / np.float32(n_inside)
        finite &= cells.is_finite(mean_grads, cell * mean_grads.shape[1], mean_grads.shape[1])
    room = (n + BLOCK) // BLOCK * BLOCK
    shapes = np.empty((n + SLACK, SHAPE + cells.padded(depth)), np.float32)
    alphas, weights = np.empty((room, LANES), np.float32), np.empty((room, LANES), np.float32)
    g, slots, shares = (
        np.empty((room, LANES), np.float32),
        np.empty(room, np.int64),
        np.empty(n, np.float32),
    )
    hits, rows = np.empty(n + LANES, np.uint32), np.empty(room, np.uint32)
    fill_shapes(splats, ranks, start, n, left, top, shapes)
    for cell in range(LANES):
        count = cells.listed(masks, start, n, cell, hits)
        count = cells.sweep(shapes, hits, count, cell, max_alpha, states, alphas, weights, rows)
        if count == 0:
            continue
        for m in range(count):
            slots[m] = pair[start + rows[m]] - base
        for m in range(count, (count + BLOCK - 1) // BLOCK * BLOCK):
            slots[m], rows[m] = spare, 0
        cell_adjoint.slopes(shapes, rows, grads, count, cell, depth, g)
        if grad_means.shape[2] > 0:
            cell_adjoint.add_slopes_of_means(
                splats, column, ranks, start, rows, count, cell, mean_grads, g
            )
            cells.sum_lanes(weights, count, shares)
            cell_adjoint.record_means(
                shares, mean_grads, count, cell, slots, N_GEOMETRY + cells.padded(channels), records
            )
        cell_adjoint.unwind(alphas, weights, g, count, max_alpha)
        cell_adjoint.record_colors(weights, tall_grads, channels, count, cell, slots, records)
        cell_adjoint.record_geometry(g, count, cell, slots, records)
        if absolute:
            cell_adjoint.record_absolute(g, count, cell, shapes, rows, slots, records)
    for k in range(n):
        cell_adjoint.whiten(records, pair[start + k] - base, shapes, k)
    return finite


@kernel
def _fill_records(
    queue, first_tile, last_tile, base, n_pairs, splats, tile_starts, ranks, pair, masks, used,
    max_alpha, width, height, channels, grad, grad_means, grad_alpha, absolute, records, finite,
):  # fmt: skip
    """Records of a band's pairs, the first of which is `base`; see `_backward_tile`."""
    columns = (width + TILE - 1) // TILE
    tile = claim(queue)
    while tile < last_tile:
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            cell_adjoint.clear(records, pair[k] - base)
        finite[tile] = _backward_tile(
            splats, ranks, pair, masks, tile_starts[tile], used[tile],
            (tile % columns) * TILE, (tile // columns) * TILE, width, height, channels,
            max_alpha, grad, grad_means, grad_alpha, absolute, base,
            n_pairs + tile - first_tile, records,
        )  # fmt: skip
        tile = claim(queue)


@kernel
def _add_records(first, last, records, starts, order, channels, sums, to_colors, to_cell_colors):
    """Add the records of a band, `starts` [V + 1] of which are a Gaussian's, in their order."""
    base, column = starts[0], N_GEOMETRY + cells.padded(channels)
    for m in range(first, last):
        following = np.int64(order[min(m + AHEAD_OF_CACHE, len(order) - 1)]) * channels
        prefetch(to_colors, following)
        prefetch(to_colors, following + channels - 1)
        for k in range(starts[m] - base, starts[m + 1] - base):
            for d in range(N_GEOMETRY):
                sums[m, d] += records[k, d]
            for d in range(channels):
                to_colors[order[m], d] += records[k, N_GEOMETRY + d]
            cell_adjoint.add_means(records, k, column, to_cell_colors, order[m])


@kernel
def _to_ellipses(
    first, last, splats, order, sums, to_means2d, moments, to_opacities, to_absolute
):  # fmt: skip
    """Gradients to a Gaussian's ellipse from its sums."""
    for m in range(first, last):
        i, p, q, r = order[m], splats[m, 2], splats[m, 3], splats[m, 4]
        to_means2d[i, 0] = 2 * p * sums[m, 1]
        to_means2d[i, 1] = 2 * (q * sums[m, 1] + r * sums[m, 2])
        moments[i, 0], moments[i, 1], moments[i, 2] = sums[m, 3], sums[m, 4], sums[m, 5]
        to_opacities[i] = sums[m, 0] * 2.0 ** (-splats[m, 5]) / math.log(2.0)
        if len(to_absolute) > 0:
            to_absolute[i, 0], to_absolute[i, 1] = sums[m, 6], sums[m, 7]


def backward(
    n, splats, order, tile_starts, ranks, pair, pair_starts, masks, used, max_alpha, grad,
    grad_means, grad_alpha, absolute,
):  # fmt: skip
    """Gradients of n Gaussians, band by band, each Gaussian's records summed in order of its pairs.

    Args: masks, used as `forward` returned them; grad [H, W, D] of the render, grad_means [⌈H/4⌉,
      ⌈W/4⌉, E], grad_alpha [H, W]; absolute: whether to gather the absolute gradient too.
    Returns: gradients to means2d [n, 2]; moments [n, 3] for `ellipses.project_adjoint`; gradients
      to opacities [n], the absolute gradient to means2d [n or 0, 2], to colors [n, D], to
      cell_colors [n, E]; whether the image's gradient is finite.
    """
    height, width, channels = grad.shape
    flat, flat_alpha = grad.reshape(-1), grad_alpha.reshape(-1)
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    finite, bands = np.ones(len(tile_starts) - 1, np.bool_), len(pair_starts)
    tiles = [band_start(band, rows) * columns for band in range(bands + 1)]
    n_pairs = np.ptp(pair_starts[:, [0, -1]], axis=1).astype(np.int64)
    column = N_GEOMETRY + cells.padded(channels)
    cell_columns = cells.whole(grad_means.shape[2])
    room = int((n_pairs + np.diff(tiles)).max())
    records = np.empty((room, column + cell_columns), np.float32)
    sums = np.zeros((len(order), N_GEOMETRY), np.float32)
    to_colors = np.zeros((n, channels), np.float32)
    to_cell_colors = np.zeros((n, cell_columns), np.float32)
    for band, starts in enumerate(pair_starts):
        in_every_thread(
            _fill_records, np.full(1, tiles[band], np.int64), tiles[band], tiles[band + 1],
            int(starts[0]), int(n_pairs[band]), splats, tile_starts, ranks, pair, masks, used,
            max_alpha, width, height, channels, flat, grad_means, flat_alpha, absolute, records,
            finite,
        )  # fmt: skip
        in_parts(_add_records, len(order), records, starts, order, channels, sums, to_colors,
                 to_cell_colors)  # fmt: skip
    to_means2d, moments = np.zeros((n, 2), np.float32), np.zeros((n, 3), np.float32)
    to_opacities = np.zeros(n, np.float32)
    to_absolute = np.zeros((n if absolute else 0, 2), np.float32)
    in_parts(_to_ellipses, len(order), splats, order, sums, to_means2d, moments, to_opacities,
             to_absolute)  # fmt: skip
    return (
        to_means2d,
        moments,
        to_opacities,
        to_absolute,
        to_colors,
        to_cell_colors[:, : grad_means.shape[2]],
        bool(finite.all()),
    )
