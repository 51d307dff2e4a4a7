"""Frames of a video for reconstruction: motion of the picture, blur, and the choice of frames."""

from __future__ import annotations

import itertools

import numpy as np

BLOCK = 64  # pixels a side: shifts of up to half of it are seen
STRIDE = 32
LEAST_PEAK = 0.05  # of a phase correlation, 1: an exact shift; lower ones are chance
STEP = 0.075  # of the picture's width, by which it moves from one frame that is taken to the next
WEAK = 0.5  # of the median variance: less detail than half of the views have
SOFT = 0.6  # of the median ratio of fine to coarse detail


def shifts(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Motion of each block of a picture, by phase correlation (Kuglin and Hines 1975).

    Args: before, after: grey [H, W], H and W at least BLOCK.
    Returns: [B, 2] (x, y) in pixels, whole ones.
    Choices: a block without a clear peak, such as a plain wall, moves as the median of those with
      one; 0 of none.
    """
    window = np.hanning(BLOCK)[:, None] * np.hanning(BLOCK)

    def spectra(image: np.ndarray) -> np.ndarray:
        views = np.lib.stride_tricks.sliding_window_view(image.astype(np.float32), (BLOCK, BLOCK))[
            ::STRIDE, ::STRIDE
        ]
        blocks = views.reshape(-1, BLOCK, BLOCK)
        return np.asarray(np.fft.rfft2((blocks - blocks.mean((1, 2), keepdims=True)) * window))

    product = spectra(after) * spectra(before).conj()
    surface = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-6), (BLOCK, BLOCK)).reshape(
        -1, BLOCK**2
    )
    peak = surface.argmax(1)
    moved = np.stack([peak % BLOCK, peak // BLOCK], 1).astype(float)
    moved = np.where(moved >= BLOCK // 2, moved - BLOCK, moved)
    clear = surface.max(1) > LEAST_PEAK
    moved[~clear] = np.median(moved[clear], 0) if clear.any() else 0
    return moved


def progress(moves: np.ndarray, step: float = STEP) -> np.ndarray:
    """Steps of `step` that the picture has moved up to each frame, f64 [F], begun ones in part;
    ascending.

    Args: moves: [F, B, 2] of each block from the frame before, in units of the picture's width;
      moves[0] is 0.
    Choices: moves add up with their signs, so that a trembling hand stays where it is; half of the
      blocks must have moved, so that going forward and turning about the view's axis count, which
      leave the middle in its place.
    """
    total, reached, begun = np.zeros_like(moves[0]), 0, 0.0
    out = np.zeros(len(moves))
    for k, move in enumerate(moves):
        total = total + move
        begun = max(begun, float(np.median(np.linalg.norm(total, axis=1))) / step)
        if begun >= 1:
            reached, begun, total = reached + 1, 0.0, np.zeros_like(total)
        out[k] = reached + begun
    return out


def choose(steps: np.ndarray, sharpness: np.ndarray, at_most: int) -> np.ndarray:
    """The frames to take, ascending: of each step the sharpest of its middle half.

    Args: steps: [F] of `progress`; sharpness: [F], higher is sharper.
    Choices: where there are more steps than `at_most`, several become one; less than half of a step
      at the end is left out. Of equally sharp frames the first is taken.
    """
    n_steps = max(int(steps[-1] + 0.5), 1)
    edges = np.linspace(0, n_steps, min(n_steps, at_most) + 1)
    frames = []
    for low, high in itertools.pairwise(edges):
        inside = (steps >= low) & (steps < high)
        middle = inside & (steps >= 0.75 * low + 0.25 * high) & (steps <= 0.25 * low + 0.75 * high)
        rows = np.flatnonzero(middle if middle.any() else inside)
        if len(rows):
            frames.append(rows[np.argmax(sharpness[rows])])
    return np.array(frames, int)


def laplacian_variance(grey: np.ndarray) -> float:
    """Variance of the 4-neighbour Laplacian of an image [H, W], inside its borders (Pech-Pacheco et
    al. 2000).

    Returns: 0.0 of an image under 3 pixels a side.
    """
    if min(grey.shape) < 3:
        return 0.0
    values = grey.astype(np.float32, copy=False)
    inside = values[1:-1, 1:-1]
    beside = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return float((beside - 4 * inside).var(dtype=np.float64))


def detail(grey: np.ndarray) -> tuple[float, float]:
    """(variance of the Laplacian at full resolution, at a quarter of it) of an image [H, W]."""
    height, width = (side // 4 * 4 for side in grey.shape)
    coarse = (
        grey[:height, :width].reshape(height // 4, 4, width // 4, 4).mean((1, 3), dtype=np.float32)
    )
    return laplacian_variance(grey), laplacian_variance(coarse)


def blurred(details: np.ndarray) -> np.ndarray:
    """True for views far less sharp than their capture's median, bool [V], of `detail` [V, 2].

    Choices: two signs must agree. A plain wall has little detail at either scale, and a carpet more
      at the fine one; blur takes the fine detail and leaves the coarse. Both are ratios to the
      medians, so that neither the images' size nor their contrast matters, and a capture that is
      blurred throughout has no blurred view.
    """
    fine, coarse = details.T
    softness = fine / np.maximum(coarse, 1e-9)
    return np.asarray((fine < WEAK * np.median(fine)) & (softness < SOFT * np.median(softness)))
