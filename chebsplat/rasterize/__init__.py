"""Differentiable Gaussian rasterization behind one signature, in the words of gsplat.

Means and scales are in scene units, cameras are OpenCV's (x right, y down, z forward) as viewmats
[C, 4, 4] from the world, pixel (0, 0) has its centre at (0.5, 0.5), colours have any number of
channels. May import kernels, splats.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


def rasterize(
    means: Tensor, *args: Any, backend: str = "auto", **options: Any
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians; arguments and results as `reference.rasterize`.

    Args: backend: `cpu` (float32, numba), `reference` (plain torch, any float type), `cuda`
      (gsplat), or `auto`: cuda for tensors on a GPU, cpu for float32 on the CPU, otherwise the
        reference.
    Raises: ValueError on an unknown backend, or tensors that the chosen one does not take.
    """
    import torch  # takes a second, and others here need none of it

    if backend == "auto":
        on_cpu = "cpu" if means.dtype == torch.float32 else "reference"
        backend = {"cuda": "cuda", "cpu": on_cpu}.get(means.device.type, "reference")
    module: Any
    # spelt out, not looked up by name: a stage's identity is the code that it imports
    if backend == "cpu":
        from chebsplat.rasterize import cpu as module
    elif backend == "cuda":
        from chebsplat.rasterize import cuda as module
    elif backend == "reference":
        from chebsplat.rasterize import reference as module
    else:
        raise ValueError(f"backend {backend!r} is none of auto, cpu, cuda, reference")
    rendered: tuple[Tensor, Tensor, dict[str, Any]] = module.rasterize(means, *args, **options)
    return rendered
