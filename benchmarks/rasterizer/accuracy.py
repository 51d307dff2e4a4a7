"""Errors of images and gradients against float64, under a loss linear in the image.

Pixels are left out where rounding moves an alpha across 1/255 or a transmittance across the stop: the float64 image
changes if those limits move by 1e-5.
"""

from __future__ import annotations

from unittest import mock

import torch

from benchmarks.rasterizer.actions import CHANNELS, SIZE, N, threads
from benchmarks.rasterizer.memory import camera, scene
from chebsplat.rasterize import rasterize, reference

THREADS = 4


def differentiated(backend: str, dtype: torch.dtype, weights: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
    device = "cuda" if backend == "cuda" else "cpu"
    arguments = [a.detach().to(device, dtype).requires_grad_(True) for a in scene(N, CHANNELS)]
    viewmats, K, width, height = camera(*SIZE)
    weights = weights.to(device, dtype)
    render = rasterize(
        *arguments, viewmats.to(weights), K.to(weights), width, height, backend=backend, max_alpha=0.999
    )[0]
    render.backward(weights)
    return render.detach().cpu(), [a.grad.cpu() for a in arguments if a.grad is not None]


def decided_pixels() -> torch.Tensor:
    """[1, H, W], by the float64 image under both limits a little lower and a little higher."""
    images = []
    for sign in (-1, 1):
        limits = {"ALPHA_MIN": reference.ALPHA_MIN * (1 + sign * 1e-5), "T_MIN": reference.T_MIN * (1 + sign * 1e-5)}
        with mock.patch.multiple(reference, **limits), torch.no_grad():
            doubled = [a.double() for a in (*scene(N, CHANNELS), *camera(*SIZE)[:2])]
            images.append(rasterize(*doubled, *SIZE, backend="reference", max_alpha=0.999)[0])
    return (images[0] - images[1]).abs().amax(-1) < 1e-12


def errors(backends: dict[str, tuple[str, torch.dtype]]) -> dict[str, dict[str, float]]:
    """Image (root mean square, largest) and gradient (relative, worst of five) errors by name."""
    threads(THREADS)
    decided = decided_pixels()
    weights = torch.randn(1, SIZE[1], SIZE[0], CHANNELS, generator=torch.Generator().manual_seed(1))
    weights[~decided] = 0
    exact, slopes = differentiated("reference", torch.float64, weights)
    found = {}
    for name, (backend, dtype) in backends.items():
        render, grads = differentiated(backend, dtype, weights)
        difference = (render - exact)[decided]
        relative = [float((a - b).norm() / b.norm()) for a, b in zip(grads, slopes, strict=True)]
        found[name] = {
            "image": float(difference.square().mean().sqrt()),
            "image at worst": float(difference.abs().max()),
            "gradient": max(relative),
            "left out": float((~decided).double().mean()),
        }
    return found


def equal_bits() -> bool:
    results = []
    weights = torch.rand(1, SIZE[1], SIZE[0], CHANNELS, generator=torch.Generator().manual_seed(2))
    for n in (1, 2, 4):
        threads(n)
        render, grads = differentiated("cpu", torch.float32, weights)
        results.append([render, *grads])
    return all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
