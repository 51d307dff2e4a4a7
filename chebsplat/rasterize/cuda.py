"""The CUDA backend: gsplat 1.5.3, imported on first use, with our names for its results."""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import Tensor

log = logging.getLogger("chebsplat")

MAX_ALPHA = 0.999  # built into gsplat's kernels


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    max_alpha: float = 0.99,
    rasterize_mode: str = "classic",
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """As `reference.rasterize`, of float32 tensors on a GPU; `means2d.absgrad` [C, N, 2] is there after backward.

    Raises: ValueError unless the Gaussians are float32 on a GPU; ImportError, with the remedy, without gsplat.
    Choices: gsplat fixes the ceiling of alpha at 0.999; another `max_alpha` is reported once and has no effect.
    """
    if means.dtype != torch.float32 or means.device.type != "cuda":
        raise ValueError(f"means is {means.dtype} on {means.device}; the cuda backend takes float32 on a GPU")
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise ImportError("the cuda backend needs gsplat: pip install 'chebsplat[cuda]'") from error
    _report_ceiling(max_alpha)
    renders, alphas, found = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        near_plane=near_plane, far_plane=far_plane, eps2d=eps2d, sh_degree=None, packed=False,
        backgrounds=backgrounds, absgrad=True, rasterize_mode=rasterize_mode,
    )  # fmt: skip
    return renders, alphas, named(found)


def named(found: dict[str, Any]) -> dict[str, Any]:
    """Our meta of gsplat's: radii [C, N] from its [C, N, 2], and means2d retains its gradient."""
    means2d, radii = found["means2d"], found["radii"]
    if means2d.requires_grad:
        means2d.retain_grad()
    radii = radii.amax(-1) if radii.ndim == 3 else radii
    return {"means2d": means2d, "conics": found["conics"], "depths": found["depths"], "radii": radii}


_reported: set[float] = set()


def _report_ceiling(max_alpha: float) -> None:
    if max_alpha != MAX_ALPHA and max_alpha not in _reported:
        _reported.add(max_alpha)
        log.warning("gsplat clamps alpha at %s, not at %s: renders differ where Gaussians are opaque",
                    MAX_ALPHA, max_alpha)  # fmt: skip
