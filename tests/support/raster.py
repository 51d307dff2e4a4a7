"""Scenes, cameras and oracles for the tests of the rasterizer."""

import chebsplat  # noqa: F401  # isort: skip  # before torch, which then waits passively
import torch

from chebsplat.rasterize import rasterize
from chebsplat.rasterize.projection import project

NAMES = ("means", "quats", "scales", "opacities", "colors")
MIN, STOP, CEILING = 1 / 255, 1e-4, 0.99
NEAR_A_LIMIT = 1e-5  # relative; float32 rounds an alpha by about 1e-6


def scene(n=150, channels=5, seed=0):
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g) * torch.tensor([3.0, 2.0, 3.0]) - torch.tensor(
        [1.5, 1.0, -1.0]
    )
    quats, scales = torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.15 + 0.01
    return [
        means,
        quats,
        scales,
        torch.rand(n, generator=g) * 0.9 + 0.05,
        torch.rand(n, channels, generator=g),
    ]


def camera(width=53, height=37, views=1):
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 3] = torch.arange(views) * 0.3
    K = torch.tensor([[45.0, 0, width / 2], [0, 42.0, height / 2], [0, 0, 1]]).repeat(views, 1, 1)
    return viewmats, K, width, height


def gradients(arguments, dtype, backend, weights, device="cpu", **options):
    """Render, alpha, gradients to the arguments and to means2d, and meta, under a loss linear in
    render and alpha.
    """
    _, height, width, _ = weights.shape
    return _differentiated(
        arguments,
        dtype,
        weights,
        lambda a, k: rasterize(*a, *k, width, height, backend=backend, **options),
        device,
    )


def brute_force(arguments, weights, **options):
    """As `gradients`, in float64, by every Gaussian at every pixel."""
    _, height, width, _ = weights.shape
    return _differentiated(
        arguments,
        torch.float64,
        weights,
        lambda a, k: _every_pair(*a, *k, width, height, **options),
    )


def undecided(arguments, width, height, views=1, **options):
    """Pixels [C, H, W] where rounding to float32 may move an alpha or a transmittance across a
    limit.
    """
    viewmats, K, _, _ = camera(width, height, views)
    arguments = [a.double() for a in arguments]
    *_, found = _every_pair(*arguments, viewmats.double(), K.double(), width, height, **options)
    return found["undecided"]


def _differentiated(arguments, dtype, weights, render_with, device="cpu"):
    views, height, width, _ = weights.shape
    arguments = [a.detach().to(device, dtype, copy=True).requires_grad_(True) for a in arguments]
    viewmats, K, _, _ = camera(width, height, views)
    render, alpha, meta = render_with(arguments, (viewmats.to(device, dtype), K.to(device, dtype)))
    weights = weights.to(device, dtype)
    ((render * weights).sum() + (alpha * weights[..., :1]).sum()).backward()
    return (
        render.detach(),
        alpha.detach(),
        [a.grad for a in arguments] + [meta["means2d"].grad],
        meta,
    )


def _every_pair(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height,
    backgrounds=None, rasterize_mode="classic", max_alpha=CEILING,
):  # fmt: skip
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2).to(means)
    views = [
        project(means, quats, scales, v, k, (width, height), (0.01, 1e10), 0.3)
        for v, k in zip(viewmats, Ks, strict=True)
    ]
    means2d = torch.stack([view.means2d for view in views])
    if means2d.requires_grad:
        means2d.retain_grad()
    renders, alphas, doubts = [], [], []
    for c, view in enumerate(views):
        strength = torch.where(torch.isfinite(opacities), opacities, 0)
        strength = strength * view.compensations if rasterize_mode == "antialiased" else strength
        shown = view.visible & (strength >= MIN) & torch.isfinite(colors).all(-1)
        index = shown.nonzero()[:, 0]
        index = index[view.depths[index].argsort(stable=True)]
        dx, dy = (pixels[:, None] - means2d[c, index]).unbind(-1)
        p, q, r = view.whitening[index].unbind(-1)
        free = strength[index] * torch.exp(-((p * dx + q * dy) ** 2) - (r * dy) ** 2)
        alpha = torch.where(free >= MIN, free.clamp_max(max_alpha), 0)
        after = torch.cumprod(1 - alpha, -1)
        before = torch.cat([torch.ones_like(after[:, :1]), after], -1)[:, :-1]
        weight = torch.where(after > STOP, alpha * before, 0)
        seen = before > STOP * (1 - NEAR_A_LIMIT)
        doubt = seen & ((free / MIN - 1).abs() < NEAR_A_LIMIT) | (
            (after / STOP - 1).abs() < NEAR_A_LIMIT
        )
        doubt |= seen & ((free / max_alpha - 1).abs() < NEAR_A_LIMIT)
        render, total = weight @ colors[index], weight.sum(-1, keepdim=True)
        if backgrounds is not None:
            render = render + (1 - total) * backgrounds[c]
        renders.append(render.reshape(height, width, -1))
        alphas.append(total.reshape(height, width, 1))
        doubts.append(doubt.any(-1).reshape(height, width))
    meta = {"means2d": means2d, "undecided": torch.stack(doubts)}
    return torch.stack(renders), torch.stack(alphas), meta
