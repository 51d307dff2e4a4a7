"""Colours that come with points, held against the photos that show these points."""

from __future__ import annotations

import numpy as np


def tell_of(colors: np.ndarray, pixels: np.ndarray) -> bool:
    """Do colours u8 [N, 3] of points tell more of the pixels u8 [N, 3] that show them than one
    colour for all would?

    Choices: by mean distance, with the pixels' median for the one colour: what is all black, all of
      one colour, drawn at random or written in other units tells nothing, and needs no list of such
      cases. Of no points, or of pixels that are all alike, nothing can be told: yes.
    """
    if not len(pixels):
        return True
    wanted = pixels.astype(np.float64)
    by_one = np.abs(wanted - np.median(wanted, 0)).mean()
    return bool(by_one == 0 or np.abs(wanted - colors).mean() < by_one)
