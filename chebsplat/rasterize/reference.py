"""The oracle of rasterizing, in plain torch of any float type, and of `lift`, in float64.

It goes tile by tile. At an offset (x, y) from a tile's middle, ln α of a Gaussian is a quadratic in
x and y: six coefficients. So one matrix product gives ln α of all its pixels and Gaussians, and a
second one, of compositing weights and colours, the image. Tiles with about as many Gaussians go
together, filled up with invisible ones.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import hardshrink

from chebsplat.rasterize.cells import CELL
from chebsplat.rasterize.projection import Projected, compensated, is_antialiased, project

ALPHA_MIN = 1 / 255  # fainter contributions are skipped
T_MIN = 1e-4  # compositing stops before transmittance falls to this
TILE = 8  # pixels; larger ones waste more products than they save look-ups
BATCH = 1 << 19  # pixels times Gaussians at a time, for the cache's sake
UNSEEN = -1e4  # ln α of a filler


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
    absgrad: bool = False,
    cell_colors: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians front to back into C views, D channels at once; differentiable by autograd.

    Args:
      means:       [N, 3] centres, scene units.
      quats:       [N, 4] wxyz, any length.
      scales:      [N, 3] standard deviations, scene units, > 0.
      opacities:   [N] in (0, 1).
      colors:      [N, D] or [C, N, D], already evaluated; any number of channels.
      viewmats:    [C, 4, 4] world to camera, OpenCV axes.
      Ks:          [C, 3, 3] pixels.
      backgrounds: [C, D]; black if None.
      max_alpha:   ceiling of one Gaussian's alpha; its gradient above is zero.
      rasterize_mode: `antialiased` multiplies opacities by √(det Σ / det(Σ + eps2d I)), Σ the
        projected covariance, so that a Gaussian smaller than a pixel fades as it shrinks, to 0.005
        at least; `classic` does not.
      absgrad:     whether meta's `means2d` carries `absgrad` [C, N, 2], after backward the sum over
        pixels of the absolute gradient.
      cell_colors: [N, E] or [C, N, E], channels of which only means over cells of 4×4 pixels are
        wanted, on black; on the cpu backend they take a sixteenth of the products of `colors`.
    Returns: renders [C, H, W, D], alphas [C, H, W, 1], and meta: `means2d` [C, N, 2] (retains its
      gradient), `conics` [C, N, 3], `depths` [C, N], `radii` [C, N] and, given cell_colors, `cells`
      [C, ⌈H/4⌉, ⌈W/4⌉, E], each the mean over those of its pixels that lie in the image.
    Raises: ValueError on an unknown mode or, in backward, on a gradient of the image that is not
      finite.
    Choices: gsplat's constants, so that every backend renders a scene alike.
    """
    antialiased = is_antialiased(rasterize_mode)
    n_colors, colors = colors.shape[-1], with_cells(colors, cell_colors)
    views = [project(means, quats, scales, v, k, (width, height), (near_plane, far_plane), eps2d)
             for v, k in zip(viewmats, Ks, strict=True)]  # fmt: skip
    means2d = torch.stack([view.means2d for view in views])
    if means2d.requires_grad:
        means2d.retain_grad()
    absolute = torch.zeros_like(means2d) if absgrad else None
    if absgrad:
        means2d.absgrad = absolute  # type: ignore[attr-defined]
    renders, alphas = [], []
    for c, view in enumerate(views):
        strengths = compensated(opacities, view.compensations) if antialiased else opacities
        channels = colors if colors.ndim == 2 else colors[c]
        sums = None if absolute is None else absolute[c]
        render, alpha = _composite(
            means2d[c], view, strengths, channels, width, height, max_alpha, sums
        )
        if render.requires_grad:
            render.register_hook(partial(_refuse_broken, c))
        renders.append(render)
        alphas.append(alpha)
    meta = {
        "means2d": means2d,
        "conics": torch.stack([view.conics for view in views]),
        "depths": torch.stack([view.depths for view in views]),
        "radii": torch.stack([view.radii for view in views]),
    }
    images, coverage = torch.stack(renders), torch.stack(alphas)
    images, cells = images[..., :n_colors], images[..., n_colors:]
    if backgrounds is not None:
        images = images + (1 - coverage) * backgrounds[:, None, None]
    return images, coverage, meta if cell_colors is None else meta | {"cells": cell_means(cells)}


def with_cells(colors: Tensor, cell_colors: Tensor | None) -> Tensor:
    """Both kinds of channels side by side, [N, D + E], or [C, N, D + E] if either is by view."""
    if cell_colors is None:
        return colors
    shape = torch.broadcast_shapes(colors.shape[:-1], cell_colors.shape[:-1])
    return torch.cat([colors.expand(*shape, -1), cell_colors.expand(*shape, -1)], -1)


def cell_means(images: Tensor) -> Tensor:
    """Means [C, ⌈H/4⌉, ⌈W/4⌉, E] of images [C, H, W, E] over cells of 4×4, cut at the edge."""
    means = torch.nn.functional.avg_pool2d(
        images.permute(0, 3, 1, 2), CELL, ceil_mode=True, count_include_pad=False
    )
    return means.permute(0, 2, 3, 1)


def _refuse_broken(view: int, gradient: Tensor | None) -> None:
    if gradient is not None and not torch.isfinite(gradient).all():
        raise ValueError(f"the gradient of the image of view {view} is not finite")


def _composite(
    means2d: Tensor, view: Projected, opacities: Tensor, channels: Tensor, width: int, height: int,
    max_alpha: float, absolute: Tensor | None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Render [H, W, D], alpha [H, W, 1] of one view; backward adds to `absolute` [N, 2], if any."""
    visible = (
        view.visible
        & (opacities >= ALPHA_MIN)
        & torch.isfinite(opacities)
        & torch.isfinite(channels).all(-1)
    )
    index = visible.nonzero()[:, 0]
    index = index[torch.argsort(view.depths[index], stable=True)]
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    table = torch.cat([means2d, view.whitening, opacities[:, None], channels], 1)[index]
    owner, tile = _pairs(
        table[:, :6].detach(), view.covariances[index].detach(), columns, rows, width, height, TILE
    )
    pairs = table.index_select(0, owner)
    middles = torch.stack([tile % columns, tile // columns], -1) * TILE + TILE / 2
    offsets, whitening = pairs[:, :2] - middles, pairs[:, 2:5]
    quadratics = _quadratics(offsets, whitening, pairs[:, 5].log())
    filler = quadratics.new_tensor([[UNSEEN, 0, 0, 0, 0, 0]])
    quadratics, colors = (
        torch.cat([quadratics, filler]),
        torch.cat([pairs[:, 6:], torch.zeros_like(channels[:1])]),
    )
    counts = torch.bincount(tile, minlength=columns * rows)
    starts = counts.cumsum(0) - counts
    by_count = torch.argsort(counts)
    at = torch.arange(TILE, dtype=means2d.dtype, device=means2d.device) - (TILE - 1) / 2
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(at, at, indexing="ij"))
    basis = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)  # [TILE², 6]
    images = []
    for tiles in _batches(by_count, counts):
        most = int(counts[tiles[-1]])
        slots = torch.arange(most, device=tiles.device)
        # [T, most]
        members = torch.where(slots < counts[tiles, None], starts[tiles, None] + slots, len(tile))
        log_alphas = basis @ quadratics[members].mT
        if absolute is not None and log_alphas.requires_grad:
            real = members < len(tile)
            at_pair = members.clamp_max(max(len(tile) - 1, 0))
            shapes = torch.cat([offsets, whitening], 1).detach()[at_pair]
            who = torch.where(real, index[owner][at_pair], -1)
            log_alphas.register_hook(partial(_add_absolute, absolute, shapes, who, x, y))
        weights = _weights(log_alphas, max_alpha)
        images.append(torch.cat([weights @ colors[members], weights.sum(-1, keepdim=True)], -1))
    image = torch.cat(images)[torch.argsort(by_count)].reshape(rows, columns, TILE, TILE, -1)
    image = image.transpose(1, 2).reshape(rows * TILE, columns * TILE, -1)[:height, :width]
    return image[..., :-1], image[..., -1:]


def _add_absolute(
    absolute: Tensor, shapes: Tensor, who: Tensor, x: Tensor, y: Tensor, gradient: Tensor
) -> None:
    """Add Σ |∂L/∂mean| over pixels to Gaussians who [T, M] (−1: none), from the gradient [T, TILE²,
    M] to ln α and shapes [T, M, 5].
    """
    mean_x, mean_y, p, q, r = (t[:, None] for t in shapes.unbind(-1))
    dx, dy = x[:, None] - mean_x, y[:, None] - mean_y
    u = p * dx + q * dy
    along_x, along_y = 2 * p * u, 2 * (q * u + r * r * dy)
    sums = torch.stack([(gradient * t).abs().sum(1) for t in (along_x, along_y)], -1)
    absolute.index_add_(0, who[who >= 0], sums[who >= 0])


def _pairs(
    table: Tensor, covariances: Tensor, columns: int, rows: int, width: int, height: int, side: int
) -> tuple[Tensor, Tensor]:
    """Pairs of M Gaussians and tiles where they may reach 1/255: indices [P] of both, by tile, in
    order.

    Args: table [M, 6] means, whitening and opacities; covariances [M, 3].
    """
    u, v, p, q, r, opacities = table.unbind(-1)
    limit = (255 * opacities).log().clamp_min(0) + 1e-3  # a little more than enough
    reach_x, reach_y = (
        (2 * limit * covariances[:, 0]).sqrt(),
        (2 * limit * covariances[:, 2]).sqrt(),
    )
    first_x, last_x = (
        ((u + sign * reach_x).clamp(0, width - 1) // side).long() for sign in (-1, 1)
    )
    first_y, last_y = (
        ((v + sign * reach_y).clamp(0, height - 1) // side).long() for sign in (-1, 1)
    )
    across = last_x - first_x + 1
    counts = across * (last_y - first_y + 1)
    owner = torch.repeat_interleave(torch.arange(len(counts), device=u.device), counts)
    nth = torch.arange(len(owner), device=u.device) - (counts.cumsum(0) - counts)[owner]
    x, y = first_x[owner] + nth % across[owner], first_y[owner] + nth // across[owner]
    # the ellipse against the parallelogram that a tile is in whitened coordinates
    dx, dy, p, q, r = (
        x * side + side / 2 - u[owner],
        y * side + side / 2 - v[owner],
        p[owner],
        q[owner],
        r[owner],
    )
    far_u = ((p * dx + q * dy).abs() - side / 2 * (p + q.abs())).clamp_min(0)
    far_v = ((r * dy).abs() - side / 2 * r).clamp_min(0)
    near = far_u * far_u + far_v * far_v <= limit[owner]
    owner, tile = owner[near], (y * columns + x)[near]
    tile, order = torch.sort(tile, stable=True)
    return owner[order], tile


def _quadratics(offsets: Tensor, whitening: Tensor, log_opacities: Tensor) -> Tensor:
    """Coefficients [P, 6] of ln α to 1, x, y, x², xy, y²; offsets [P, 2] from tiles' middles."""
    p, q, r = whitening.unbind(-1)
    u, v = -(p * offsets[:, 0] + q * offsets[:, 1]), -r * offsets[:, 1]
    return -torch.stack(
        [
            u * u + v * v - log_opacities,
            2 * u * p,
            2 * (u * q + v * r),
            p * p,
            2 * p * q,
            q * q + r * r,
        ],
        -1,
    )


def _batches(by_count: Tensor, counts: Tensor) -> list[Tensor]:
    """Tiles, sorted by their count, in groups of at most BATCH pixels times Gaussians."""
    groups, start, most = [], 0, counts[by_count].tolist()
    for k in range(len(most)):
        if k > start and (k + 1 - start) * most[k] * TILE * TILE > BATCH:
            groups.append(by_count[start:k])
            start = k
    return [*groups, by_count[start:]]


class _Weights(torch.autograd.Function):
    """Compositing weights α_i Π_{j<i} (1 − α_j) from ln α, Gaussians by depth in the last
    dimension.

    Its adjoint is α_i T_i ∂w_i − α_i / (1 − α_i) Σ_{j>i} w_j ∂w_j: half the passes that autograd
    would make. Tests hold it to autograd.
    """

    @staticmethod
    def forward(ctx: Any, log_alphas: Tensor, max_alpha: float) -> Tensor:
        alphas = hardshrink(log_alphas.exp().clamp_max_(max_alpha), math.nextafter(ALPHA_MIN, 0))
        after = torch.cumprod(1 - alphas, -1)
        weights = alphas.clone()
        weights[..., 1:] *= after[..., :-1]
        # a mask of numbers: torch vectorises no mask of truths
        weights *= hardshrink(after, T_MIN).sign_()
        ctx.save_for_backward(alphas, weights)
        ctx.max_alpha = max_alpha
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        alphas, weights = ctx.saved_tensors
        gain = grad * weights
        behind = gain.flip(-1).cumsum_(-1).flip(-1).sub_(gain)
        slope = gain.addcmul_(behind, alphas / (1 - alphas), value=-1)
        return slope.mul_((ctx.max_alpha - alphas).sign_()), None


def _weights(log_alphas: Tensor, max_alpha: float) -> Tensor:
    weights: Tensor = _Weights.apply(log_alphas, max_alpha)
    return weights


def pixel_weights(
    gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    max_alpha: float = 0.99,
) -> np.ndarray:
    """Weights w = α T of every Gaussian at every pixel, f64 [H, W, N]; arguments as `lift.lift`."""
    means, quats, scales, opacities = (
        torch.from_numpy(np.asarray(a, np.float64)) for a in gaussians
    )
    width, height = size
    pose, intrinsics = (torch.from_numpy(np.asarray(matrix, np.float64)) for matrix in (viewmat, K))
    view = project(means, quats, scales, pose, intrinsics, (width, height), (0.01, 1e10), 0.3)
    order = torch.argsort(view.depths, stable=True).numpy()
    whitening, centers = view.whitening.numpy(), view.means2d.numpy()
    opacity = np.where(
        view.visible.numpy() & (opacities.numpy() >= ALPHA_MIN), opacities.numpy(), 0.0
    )
    y, x = np.indices((height, width)) + 0.5
    weights, transmittance = np.zeros((height, width, len(means))), np.ones((height, width))
    is_open = np.ones((height, width), bool)
    for i in order:
        (p, q, r), dx, dy = whitening[i], x - centers[i, 0], y - centers[i, 1]
        alpha = opacity[i] * np.exp(-((p * dx + q * dy) ** 2) - (r * dy) ** 2)
        alpha = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, max_alpha), 0.0)
        after = transmittance * (1 - alpha)
        is_open &= after > T_MIN
        weights[..., i] = np.where(is_open, alpha * transmittance, 0.0)
        transmittance = np.where(is_open, after, transmittance)
    return weights


def lift(
    gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    values: np.ndarray,
    counts: np.ndarray,
    gate: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights f64 [N] and sums f64 [N, C] of all Gaussians; arguments as of `lift.lift`."""
    weights = pixel_weights(gaussians, viewmat, K, size)
    weights[weights < gate * weights.max(-1, keepdims=True, initial=0)] = 0
    down, right = (-weights.shape[0] % CELL, -weights.shape[1] % CELL)
    whole = np.pad(weights, ((0, down), (0, right), (0, 0)))
    by_cell = whole.reshape(counts.shape[0], CELL, counts.shape[1], CELL, -1).sum((1, 3))
    by_cell = by_cell * counts.astype(np.float64)[..., None]
    finite = np.where(counts[..., None] > 0, values, 0).astype(np.float64)
    return by_cell.sum((0, 1)), np.einsum("yxn,yxc->nc", by_cell, finite)
