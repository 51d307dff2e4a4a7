"""LPIPS with VGG-16: the learned perceptual distance, from weights that the user brings."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

# recorded with every figure: "alex", or images scaled to [-1, 1], is another number
NET, NORMALIZE = "vgg", False
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # LPIPS' own, of images in [-1, 1]
# Channels of the 13 convolutions by their number among VGG's layers; taps follow the last of each
# line.
BLOCKS = (
    {0: 64, 2: 64},
    {5: 128, 7: 128},
    {10: 256, 12: 256, 14: 256},
    {17: 512, 19: 512, 21: 512},
    {24: 512, 26: 512, 28: 512},
)
CONV = re.compile(r"(?:net\.slice\d\.|net\.layers\.|features\.)(\d+)\.(weight|bias)$")
TAP = re.compile(r"lins?\.?(\d)\.(?:model\.)?1\.weight$")


class Lpips:
    """The distance of two images, 0 for equal ones."""

    def __init__(self, state: Mapping[str, Tensor]):
        """Args: state: tensors by name, as torchvision's VGG-16 (`features.N`), the lpips package's
          `LPIPS` or 3DGS' copy of it name them; taps `linK.model.1.weight`.
        Raises: ValueError naming the first tensor that is missing or of another shape.
        """
        tensors: dict[tuple[str, int], Tensor] = {}
        for name, tensor in state.items():
            if match := CONV.match(name):
                tensors[match[2], int(match[1])] = tensor.float()
            elif match := TAP.match(name):
                tensors["tap", int(match[1])] = tensor.float()
        before = 3
        shapes: dict[tuple[str, int], tuple[int, ...]] = {}
        for k, block in enumerate(BLOCKS):
            for layer, channels in block.items():
                shapes["weight", layer], shapes["bias", layer] = (
                    (channels, before, 3, 3),
                    (channels,),
                )
                before = channels
            shapes["tap", k] = (1, before, 1, 1)
        for key, shape in shapes.items():
            title = (
                f"lin{key[1]}.model.1.weight" if key[0] == "tap" else f"features.{key[1]}.{key[0]}"
            )
            if key not in tensors:
                raise ValueError(f"no tensor {title}")
            if tuple(tensors[key].shape) != shape:
                raise ValueError(f"{title} is {tuple(tensors[key].shape)}, not {shape}")
            if not tensors[key].isfinite().all():
                raise ValueError(f"{title} is not finite")
        self.tensors = {key: tensors[key] for key in shapes}

    @torch.no_grad()
    def distance(self, image: np.ndarray, truth: np.ndarray) -> float:
        """LPIPS of two u8 images [H, W, 3] of 16 pixels a side or more.

        Choices: images are fed in [0, 1], as 3DGS does, although the network was meant for [-1, 1].
        """
        ours, theirs = self._taps(image), self._taps(truth)
        total = 0.0
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            total += float(conv2d((_unit(a) - _unit(b)) ** 2, self.tensors["tap", k]).mean())
        return total

    def _taps(self, image: np.ndarray) -> list[Tensor]:
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float() / 255
        shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
        x, taps = (pixels - shift) / scale, []
        for k, block in enumerate(BLOCKS):
            x = max_pool2d(x, 2) if k else x
            for layer in block:
                x = relu(
                    conv2d(x, self.tensors["weight", layer], self.tensors["bias", layer], padding=1)
                )
            taps.append(x)
        return taps


def _unit(features: Tensor) -> Tensor:
    return features / (features.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)
