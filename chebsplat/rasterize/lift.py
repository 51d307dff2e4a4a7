"""The transpose of rendering cell means: values of a view's cells, summed by Gaussian.

A Gaussian's weight in a cell is the sum over its pixels of w = α T. As in `tiles_adjoint`, a tile
fills the records of its pairs, and every Gaussian's records are summed in the order of its pairs:
the same bits for any number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chebsplat.kernels.jit import kernel, lanes, serial
from chebsplat.kernels.simd import load, splat, store, where
from chebsplat.kernels.threads import in_every_thread, in_parts
from chebsplat.rasterize import binning, cell_adjoint, cells, ellipses, tiles
from chebsplat.rasterize.binning import TILE, band_start
from chebsplat.rasterize.blocks import claim
from chebsplat.rasterize.cells import LANES, SHAPE, ZERO
from chebsplat.rasterize.tiles import fill_shapes

MAX_ALPHA, NEAR, FAR, EPS2D = np.float32(0.99), 0.01, 1e10, 0.3  # as `reference.rasterize`


class Lifted(NamedTuple):
    """One view's observations: ids i32 [M], ascending; weights f32 [M] > 0; sums f32 [M, C]."""

    ids: np.ndarray
    weights: np.ndarray
    sums: np.ndarray


@lanes
def gated(weights, count, gate):
    """weights[m] = 0 at the lanes where it is below `gate` times the lane's largest."""
    largest = splat(ZERO)
    for m in range(count):
        weight = load(weights, LANES * m)
        largest = where(weight > largest, weight, largest)
    limit = splat(gate) * largest
    for m in range(count):
        weight = load(weights, LANES * m)
        store(weights, LANES * m, where(weight >= limit, weight, splat(ZERO)))


@serial
def _lift_tile(
    splats, ranks, pair, start, stop, left, top, width, height, values, counts, gate, base, records
):
    """One tile of `_lift`: adds to the records of its pairs."""
    n, across = stop - start, counts.shape[1]
    states = np.empty((LANES, 2, LANES), np.float32)
    cells.begin(states, width - left, height - top)
    shapes, masks = np.empty((n, SHAPE), np.float32), np.empty(n + LANES, np.uint16)
    alphas, weights = np.empty((n + 1, LANES), np.float32), np.empty((n + 1, LANES), np.float32)
    hits, rows = np.empty(n + LANES, np.uint32), np.empty(n + 1, np.uint32)
    shares, slots = np.empty(n, np.float32), np.empty(n, np.int64)
    fill_shapes(splats, ranks, start, n, left, top, shapes)
    for k in range(n):
        masks[k] = cells.reach(shapes, k)
    for cell in range(LANES):
        x, y = left // 4 + (cell & 3), top // 4 + (cell >> 2)
        if y >= counts.shape[0] or x >= across or counts[y, x] == ZERO:
            continue
        count = cells.listed(masks, 0, n, cell, hits)
        count = cells.sweep(shapes, hits, count, cell, MAX_ALPHA, states, alphas, weights, rows)
        gated(weights, count, gate)
        cells.sum_lanes(weights, count, shares)
        n_slots = 0
        for m in range(count):
            if shares[m] > ZERO:
                shares[n_slots], slots[n_slots] = shares[m], pair[start + rows[m]] - base
                n_slots += 1
        cell_adjoint.record_means(shares, values, n_slots, y * across + x, slots, 0, records)


@kernel
def _fill_records(
    queue, last_tile, base, splats, tile_starts, ranks, pair, values, counts, width, height, gate,
    records,
):  # fmt: skip
    """Records of a band's pairs, the first of which is `base`; see `_lift_tile`."""
    columns = (width + TILE - 1) // TILE
    tile = claim(queue)
    while tile < last_tile:
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            cell_adjoint.clear(records, pair[k] - base)
        _lift_tile(
            splats, ranks, pair, tile_starts[tile], tile_starts[tile + 1],
            (tile % columns) * TILE, (tile // columns) * TILE, width, height,
            values, counts, gate, base, records,
        )  # fmt: skip
        tile = claim(queue)


@kernel
def _add_records(first, last, records, starts, sums):
    """Add the records of a band, `starts` [V + 1] of which are a Gaussian's, in their order."""
    for m in range(first, last):
        for k in range(starts[m] - starts[0], starts[m + 1] - starts[0]):
            cell_adjoint.add_means(records, k, 0, sums, m)


def _lift(
    splats: np.ndarray, bins: binning.Bins, values: np.ndarray, counts: np.ndarray, width: int,
    height: int, gate: np.float32,
) -> np.ndarray:  # fmt: skip
    """Sums f32 [V, E] by rank of values [cells, E], E in sixteens; count 0: left out."""
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    room = int(np.ptp(bins.pair_starts[:, [0, -1]], axis=1).max())
    records = np.empty((room, values.shape[1]), np.float32)
    sums = np.zeros((len(bins.order), values.shape[1]), np.float32)
    for band, starts in enumerate(bins.pair_starts):
        first, last = (band_start(k, rows) * columns for k in (band, band + 1))
        in_every_thread(
            _fill_records, np.full(1, first, np.int64), last, int(starts[0]), splats,
            bins.tile_starts, bins.rank, bins.pair, values, counts, width, height, gate, records,
        )  # fmt: skip
        in_parts(_add_records, len(sums), records, starts, sums)
    return sums


def binned(
    gaussians: tuple[np.ndarray, ...],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    channels: np.ndarray | None = None,
) -> tuple[binning.Bins, np.ndarray]:
    """The Gaussians that a view shows, by tile, and packed with channels f32 [N, C]; see `lift`."""
    means, quats, scales, opacities = gaussians
    viewmat, K = (np.ascontiguousarray(matrix, np.float64) for matrix in (viewmat, K))
    projected = ellipses.project(means, quats, scales, viewmat, K, *size, NEAR, FAR, EPS2D)
    means2d, covariances, whitening, _, depths, radii, _ = projected
    none = np.zeros((len(means), 0), np.float32)
    bins = binning.bin_gaussians(means2d, covariances, depths, radii, opacities, none, none, *size)
    return bins, tiles.pack(
        bins.order, means2d, whitening, opacities, none if channels is None else channels, none
    )


def lift(
    gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    values: np.ndarray,
    counts: np.ndarray,
    gate: float = 0.0,
) -> Lifted:
    """Values of one view's cells, summed by Gaussian: Σ w q b and Σ w q.

    Args:
      gaussians: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], activated, float32.
      viewmat:   [4, 4] world to camera, OpenCV axes; K [3, 3] pixels.
      size:      width and height, pixels.
      values:    b [⌈H/4⌉, ⌈W/4⌉, C], of cells of 4×4 pixels.
      counts:    q [⌈H/4⌉, ⌈W/4⌉] >= 0, what each cell counts; where it is 0, b may be anything.
      gate:      in [0, 1]: a pixel belongs to the Gaussians whose w in it is at least this part of
        the largest one's.
    Returns: the Gaussians that have a weight, with Σ w q and Σ w q b.
    Raises:  ValueError unless values and counts have a row for each cell, and are finite where they
      count.
    Choices: w as `reference.rasterize` composites by default. The gate compares within each pixel:
      that of a whole cell would hand a pixel at an edge to the larger side. Bitwise equal for any
      number of threads.
    """
    width, height = size
    shape = (height + 3) // 4, (width + 3) // 4
    if values.shape[:2] != shape or counts.shape != shape:
        raise ValueError(
            f"values {values.shape}, counts {counts.shape}; {width}×{height} pixels "
            f"have cells {shape}"
        )
    n_channels = values.shape[2]
    counted = counts > 0
    weighted = np.zeros((*shape, cells.whole(n_channels + 1)), np.float32)
    weighted[counted, :n_channels] = values[counted] * counts[counted][:, None]
    weighted[counted, n_channels] = counts[counted]
    if not (np.isfinite(weighted).all() and np.isfinite(counts).all()):
        raise ValueError("a cell that counts holds a value that is not finite")
    bins, splats = binned(gaussians, viewmat, K, size)
    flat = weighted.reshape(-1, weighted.shape[2])
    sums = _lift(splats, bins, flat, counted.astype(np.float32), width, height, np.float32(gate))
    rows = np.flatnonzero(sums[:, n_channels] > 0)
    rows = rows[np.argsort(bins.order[rows])]
    sums = sums[rows]
    return Lifted(bins.order[rows], sums[:, n_channels].copy(), sums[:, :n_channels].copy())
