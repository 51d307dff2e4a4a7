"""Exposures of rendered colours: what a photo of a scene shows of the light that it has."""

from __future__ import annotations

import math

import torch
from torch import Tensor

WHITE = 250 / 255  # above which a photo says that there is as much light at least, and no more


def exposed(colors: Tensor, stops: Tensor) -> Tensor:
    """Colours [..., W, 3], sRGB of 0 and more, after so many more stops [3] of linear light.

    Choices: near black, sRGB (IEC 61966-2-1) is proportional to light, and elsewhere sRGB + 0.055
      is a power of it: more light is one linear map there and another here. The standard's bend
      between the two is left out; each holds up to where they meet. It makes .4 grey levels of 255
      at one stop more, 1.9 at two, 4.9 at three, and less where light is taken away. Rows are
      whole, since torch takes three channels one by one several times as long.
    """
    dark, bright = 2.0**stops, 2.0 ** (stops / 2.4)
    offset = 0.055 * (bright - 1)
    lines = torch.stack([bright, offset, -(dark - bright).abs(), offset.abs(), -stops.sign()])
    bright, offset, slope, height, sign = lines.repeat(1, colors.shape[-2])
    rows = colors.flatten(-2)
    near_black = torch.addcmul(height, slope, rows).relu()
    return torch.addcmul(torch.addcmul(offset, bright, rows), sign, near_black).view_as(colors)


def cut_off(colors: Tensor, photo: Tensor) -> Tensor:
    """Colours [..., 3], where they are brighter than the white of a photo as bright as that.

    Args: photo: of the same pixels, from 0 to 1.
    Choices: what its sensor has cut off may be as bright as other photos say; there colours have no
      gradient.
    """
    return colors - (colors - torch.threshold(photo, WHITE, math.inf)).relu()
