"""Exposures of rendered colours: what a photo of a scene shows of the light that it has."""

from __future__ import annotations

import math

import torch
from torch import Tensor

WHITE = 250 / 255  # above which a photo says no more than that there is as much light


def exposed(colors: Tensor, stops: Tensor) -> Tensor:
    """Colours [..., W, 3], sRGB of 0 and more, after so many more stops [3] of linear light.

    Choices: sRGB (IEC 61966-2-1) is a power of light, so that more light is a line in it, but near
      black, where both are proportional. Here it passes from one line to the other where they meet,
      which the standard rounds off: within half a grey level up to a stop, within two up to two
      stops. Rows are whole, since torch takes three channels one by one several times as long.
    """
    dark, bright = 2.0**stops, 2.0 ** (stops / 2.4)
    offset = 0.055 * (bright - 1)
    lines = torch.stack([bright, offset, -(dark - bright).abs(), offset.abs(), -stops.sign()])
    bright, offset, slope, height, sign = lines.repeat(1, colors.shape[-2])
    rows = colors.flatten(-2)
    near_black = torch.addcmul(height, slope, rows).relu()
    return torch.addcmul(torch.addcmul(offset, bright, rows), sign, near_black).view_as(colors)


@torch.no_grad()
def with_open_white(photo: Tensor, lit: Tensor) -> Tensor:
    """A photo [..., 3], from 0 to 1, that is as bright as `lit` where it is WHITE and `lit` is
    brighter: its sensor has cut off what was there.
    """
    return photo + (lit - torch.threshold(photo, WHITE, math.inf)).relu()
