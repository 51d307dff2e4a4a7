"""Colour by spherical harmonics of the Gaussians in view, each of the bands that it has and that its masks keep."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from chebsplat.kernels.dispatch import is_compiled
from chebsplat.splats import sh_kernels
from chebsplat.splats.rows import take
from chebsplat.splats.sh import light


def colors_in_view(
    bands: Sequence[Tensor],
    masks: Tensor | None,
    index: Tensor,
    means: Tensor,
    eye: Tensor,
    degree: int,
    backend: str = "auto",
) -> Tensor:
    """Colours [V, 3], at least 0, of the Gaussians `index` i64 [V] (no row twice) as seen from `eye` [3].

    Args: bands: coefficients [N_l, 2 l + 1, 3] of bands 0 to 3 or fewer: the first N_l Gaussians have band l,
      N = N_0 ≥ N_1 ≥ ...; masks [V, 3] nested, of bands 1 to 3, None for all open; means [N, 3]; degree: the highest
      band to use; backend: of `rasterize`.
    Raises: ValueError if the degree is not within 0 and 3.
    Choices: no gradient reaches the means through the view's direction; a band that is not used gets no gradient at
      all, so that the optimizer leaves it out.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree {degree} is not within 0 and 3")
    if is_compiled(bands[0], backend):
        return sh_kernels.colors_in_view(bands, masks, index, means, eye, degree)
    coefficients = _coefficients(bands[: degree + 1], masks, index)
    directions = means.detach().index_select(0, index) - eye
    return (light(coefficients, directions, min(degree, len(bands) - 1)) + 0.5).relu()


def _coefficients(bands: Sequence[Tensor], masks: Tensor | None, index: Tensor) -> Tensor:
    """Masked coefficients [V, K, 3] of all bands. Choices: a band that only the first Gaussians have is filled up with
    zeros, rather than cut to those in view that have it: a cut has to wait for their number.
    """
    parts, n = [], len(bands[0])
    for at, band in enumerate(bands):
        whole = band if len(band) == n else torch.nn.functional.pad(band, (0, 0, 0, 0, 0, n - len(band)))
        rows = take(whole, index)
        parts.append(rows if masks is None or at == 0 else rows * masks[:, at - 1, None, None])
    return torch.cat(parts, 1)
