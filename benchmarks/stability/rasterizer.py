"""Gaussians that break a naive rasterizer (RASTERIZER: extreme inputs).

The oracle is the float64 reference. Errors: of images, the 99.9th percentile, since isolated pixels may fall on the
other side of the 1/255 cut; of gradients, the largest over parameters of the difference's norm, relative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, naive
from chebsplat.rasterize import rasterize
from chebsplat.splats.rotations import rotation_matrices

IMAGE, GRADIENT = 2e-5, 1e-2
WIDTH, HEIGHT = 40, 28
CAMERA = (torch.eye(4)[None], torch.tensor([[[35.0, 0, WIDTH / 2], [0, 33, HEIGHT / 2], [0, 0, 1]]]), WIDTH, HEIGHT)
NAMES = ("means", "quats", "scales", "opacities", "colors")
Scene = list[Tensor]


def scene(n: int = 40) -> Scene:
    """means, quats, scales, opacities, colors of Gaussians before the camera."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g) * torch.tensor([2.4, 1.6, 3.0]) - torch.tensor([1.2, 0.8, -1.0])
    scales = torch.rand(n, 3, generator=g) * 0.15 + 0.02
    values = [means, torch.randn(n, 4, generator=g), scales, torch.rand(n, generator=g) * 0.8 + 0.1]
    return [*values, torch.rand(n, 3, generator=g)]


def put(name: str, value: Any, row: int = 7) -> Callable[[], Scene]:
    """The scene with one row of one parameter replaced."""

    def make() -> Scene:
        given = scene()
        given[NAMES.index(name)][row] = torch.tensor(value) if isinstance(value, (tuple, float)) else value
        return given

    return make


def factor(name: str, by: float) -> Callable[[], Scene]:
    def make() -> Scene:
        given = scene()
        given[NAMES.index(name)][7] *= by
        return given

    return make


def single(scales: tuple[float, ...], opacity: float = 0.6) -> Callable[[], Scene]:
    def make() -> Scene:
        given = [v[:1].clone() for v in scene()]
        given[0][0], given[2][0], given[3][0] = torch.tensor([0.05, 0.02, 1.5]), torch.tensor(scales), opacity
        return given

    return make


def everything_behind() -> Scene:
    given = scene()
    given[0][:, 2] = -1
    return given


def opaque() -> Scene:
    given = scene()
    given[3][:] = 0.9999
    return given


SCENES: dict[str, Callable[[], Scene]] = {
    "no Gaussian": lambda: [v[:0] for v in scene()],
    "everything behind": everything_behind,
    "one behind": put("means", (0.1, 0.1, -1.0)),
    "one at depth 0": put("means", (0.1, 0.1, 0.0)),
    "one at the near plane": put("means", (0.0, 0.0, 0.011)),
    "one at 1e30": put("means", (1e30, 0.0, 1e30)),
    "scale 1e12": put("scales", (1e12,) * 3),
    "scale 0": put("scales", (0.0,) * 3),
    "needle 1e3 x 1e-9": single((1e3, 1e-9, 1e-9)),
    "needle 1 x 0": single((1.0, 0.0, 0.0)),
    "zero quaternion": put("quats", (0.0,) * 4),
    "quaternion of 1e20": factor("quats", 1e20),
    "quaternion of 1e-10": factor("quats", 1e-10),
    "opacity 1": put("opacities", 1.0),
    "opacity 1e-3": put("opacities", 1e-3),
    "all opaque": opaque,
    "colour 1e6": put("colors", (1e6,) * 3),
}
BROKEN = {f"{name} {bad}": put(name, (bad,) * size if size > 1 else bad)
          for name, size in zip(NAMES, (3, 4, 3, 1, 3), strict=True) for bad in (np.nan, np.inf)}  # fmt: skip
REJECTED = BROKEN | {f"scales {size:.0e}": put("scales", (size,) * 3) for size in (1e15, 1e30)}  # beyond float32


def gradients(draw: Callable[..., Tensor], given: Scene, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
    """Image, and gradients of its product with fixed weights."""
    inputs = [v.to(dtype, copy=True).requires_grad_(True) for v in given]
    image = draw(*inputs, *(v.to(dtype) for v in CAMERA[:2]), WIDTH, HEIGHT)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
    return image.detach(), list(torch.autograd.grad((image * weights).sum(), inputs, allow_unused=True,
                                                    materialize_grads=True))  # fmt: skip


def ours(*arguments: Any) -> Tensor:
    return rasterize(*arguments, backend="cpu")[0][0]


def reference(*arguments: Any) -> Tensor:
    return rasterize(*arguments, backend="reference")[0][0]


def textbook(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
             viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Tensor:  # fmt: skip
    """Splatting as the formulas read: J Σ Jᵀ + 0.3 I, inverted by ac − b², in order of depth; nothing culled."""
    means = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    R = rotation_matrices(quats / quats.square().sum(-1, keepdim=True).sqrt())
    covariances = R @ torch.diag_embed(scales**2) @ R.transpose(1, 2)
    (x, y, z), zero, K = means.unbind(-1), torch.zeros(len(means)), Ks[0]
    J = torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2, zero, K[1, 1] / z, -K[1, 1] * y / z**2], -1)
    flat = J.reshape(-1, 2, 3) @ covariances @ J.reshape(-1, 2, 3).transpose(1, 2) + 0.3 * torch.eye(2)
    a, b, c = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    u = columns[..., None] - (K[0, 0] * x / z + K[0, 2])
    v = rows[..., None] - (K[1, 1] * y / z + K[1, 2])
    power = (c * u * u + a * v * v - 2 * b * u * v) / (a * c - b * b)
    order = torch.argsort(z)
    alpha = (opacities * torch.exp(-0.5 * power)).clamp_max(0.99)[..., order]
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha], -1), -1)[..., :-1]
    return (alpha * before) @ colors[order]


def worst(found: list[Tensor], exact: list[Tensor]) -> float:
    """Largest relative error by norm over parameters; inf where one is not finite."""
    errors = []
    for x, y in zip(found, exact, strict=True):
        if not torch.isfinite(x).all():
            return float("inf")
        errors.append(float((x.double() - y).norm() / (y.norm() or 1)))
    return max(errors, default=0.0)


def percentile(found: Tensor, exact: Tensor) -> float:
    if not torch.isfinite(found).all():
        return float("inf")
    return float((found.double() - exact).abs().quantile(0.999) / max(1.0, float(exact.abs().max())))


def as_textbook(given: Scene, image: Tensor, slopes: list[Tensor], what: str) -> str:
    def attempt() -> str:
        found, grads = gradients(textbook, given, torch.float32)
        values = found if what == "image" else torch.cat([g.flatten() for g in grads])
        bad = 1 - torch.isfinite(values).double().mean().item() if values.numel() else 0.0
        if bad:
            return f"{100 * bad:.0f} % NaN"
        return f"error {percentile(found, image) if what == 'image' else worst(grads, slopes):.0e}"

    return naive(attempt)


@case("{name}: {what}", name=SCENES, what=["image", "gradient"])
def extreme(name: str, what: str) -> Outcome:
    given = SCENES[name]()
    image, slopes = gradients(reference, given, torch.float64)
    found, grads = gradients(ours, given, torch.float32)
    error, tolerance = (percentile(found, image), IMAGE) if what == "image" else (worst(grads, slopes), GRADIENT)
    return Outcome(f"{len(given[0])} Gaussians", as_textbook(given, image, slopes, what), error, tolerance)


@case("{name}: {what}", name=REJECTED, what=["image", "gradient"])
def rejected(name: str, what: str) -> Outcome:
    """One Gaussian that has no image: it is that is that of the others, every gradient finite and its own zero."""
    given, keep = REJECTED[name](), torch.arange(40) != 7
    image, slopes = gradients(ours, [v[keep] for v in scene()], torch.float32)
    found, grads = gradients(ours, given, torch.float32)
    if not all(torch.isfinite(g).all() and (g[7] == 0).all() for g in grads):
        raise ValueError("its own gradient is not zero")
    error = percentile(found, image.double()) if what == "image" else worst([g[keep] for g in grads], slopes)
    naive_outcome = as_textbook(given, image.double(), slopes, what)
    return Outcome("1 of 40 Gaussians", naive_outcome, error, IMAGE if what == "image" else 1e-6)


@case("NaN in the gradient of the image")
def broken_slope() -> Outcome:
    """An error, not a silent NaN in every parameter."""
    inputs = [v.requires_grad_(True) for v in scene()]
    image = ours(*inputs, *CAMERA)
    slope = torch.zeros_like(image)
    slope[3, 3, 0] = torch.nan

    def attempt() -> str:
        found = torch.autograd.grad(textbook(*inputs, *CAMERA), inputs, slope)
        bad = torch.cat([g.flatten() for g in found]).isnan().double().mean().item()
        return f"{100 * bad:.0f} % NaN"

    try:
        torch.autograd.grad(image, inputs, slope)
    except ValueError:
        return Outcome("1 pixel", naive(attempt), 0.0, 0.0)
    return Outcome("1 pixel", naive(attempt), float("inf"), 0.0)
