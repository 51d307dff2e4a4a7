"""Colours that come with points, held against the photos that show these points."""

from __future__ import annotations

import numpy as np


def tell_of(colors: np.ndarray, pixels: np.ndarray) -> bool:
    """True where colours u8 [N, 3] of points are nearer to the pixels u8 [N, 3] that show them than
    one colour for all is.

    Choices: by mean distance, with the pixels' median for the one colour: what is all black, all of
      one colour, drawn at random or written in other units tells nothing, and needs no list of such
      cases. Of no points, or of pixels that are all alike, nothing can be decided: True.
    """
    if not len(pixels):
        return True
    target = pixels.astype(np.float64)
    by_one = np.abs(target - np.median(target, 0)).mean()
    return bool(by_one == 0 or np.abs(target - colors).mean() < by_one)
