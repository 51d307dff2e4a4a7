"""A teacher's map of a view, of any resolution, as one value for each cell of 4×4 pixels."""

from __future__ import annotations

import numpy as np

from chebsplat.rasterize import CELL


def overlaps(n_entries: int, n_pixels: int) -> np.ndarray:
    """Part of each cell that each of n entries, spread evenly over the pixels, covers: [⌈pixels/4⌉, n], rows sum to 1.

    A last cell that the image cuts off is its part inside.
    """
    edges = np.minimum(np.arange(-(-n_pixels // CELL) + 1) * CELL, n_pixels)[:, None].astype(np.float64)
    marks = np.arange(n_entries + 1) * (n_pixels / n_entries)
    covered = np.minimum(edges[1:], marks[1:]) - np.maximum(edges[:-1], marks[:-1])
    return covered.clip(0) / (edges[1:] - edges[:-1])  # type: ignore[no-any-return]


def to_cells(
    features: np.ndarray, counts: np.ndarray, size: tuple[int, int], mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What each cell of a view says, and what it counts.

    Args:
      features: [h, w, C] of the teacher; an entry that is zero in all channels, or not finite, says nothing.
      counts:   [h, w] >= 0, what an entry counts.
      size:     width and height of the view, pixels; mask [H, W] true where a pixel counts, or None.
    Returns: values f32 [⌈H/4⌉, ⌈W/4⌉, C], counts f32 [⌈H/4⌉, ⌈W/4⌉], 0 where nothing is said.
    Choices: a cell is the mean of the entries that it lies in, by the area that each covers of it: exact on a grid of
      cells, an average of a finer one, a copy of a coarser one. A cell counts if all its pixels do, as the reduced
      pixels that a training looks at.
    """
    said = features.astype(np.float32)
    usable = np.isfinite(said).all(-1) & said.any(-1)
    share = np.where(usable, counts, 0).astype(np.float32)
    said[~usable] = 0
    width, height = size
    shape = (-(-height // CELL), -(-width // CELL))
    if share.shape != shape or height % CELL or width % CELL:
        down, across = overlaps(share.shape[0], height), overlaps(share.shape[1], width)
        sums = np.einsum("yh,hwc,xw->yxc", down, said * share[..., None], across, optimize=True)
        share = (down @ share @ across.T).astype(np.float32)
        said = (sums / np.where(share > 0, share, 1)[..., None]).astype(np.float32)
    if mask is not None:
        padded = np.pad(mask, ((0, -height % CELL), (0, -width % CELL)), constant_values=True)
        share = share * padded.reshape(shape[0], CELL, shape[1], CELL).all((1, 3))
    return said, share
