"""Propagation and gate (Eqs 9-10) of the Gaussians in view in one sweep, in numba.

`fusion.fuse_in_view` holds the plain twin, and chooses. What the gate's linear map makes of a propagated
shape is the propagated image of the regions' encodings: that half of its products is done by region, of which there are
far fewer. Sums run in a fixed order, so the gradients are the same bits for any number of threads; plain indexing would
add them up in the order in which threads arrive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.kernels.jit import inline, kernel, prange
from chebsplat.kernels.simd import exp2, fma, load, splat, spread, store, where

LANES = 16
N_BLOCKS = 16  # of the Gaussians in view, each with sums of its own
ZERO, ONE, LARGE, MINUS_LOG2E = np.float32(0), np.float32(1), np.float32(100), np.float32(-1.4426950408889634)


@inline
def _times(x, n, matrix, column, start):
    """start + Σ_j x[j] matrix[j, column:] over j < n, a multiple of four; four sums, that none waits for another."""
    step = matrix.shape[1]
    a, b, c, d = start, splat(ZERO), splat(ZERO), splat(ZERO)
    for j in range(0, n, 4):
        at = j * step + column
        a = fma(spread(x, j), load(matrix, at), a)
        b = fma(spread(x, j + 1), load(matrix, at + step), b)
        c = fma(spread(x, j + 2), load(matrix, at + 2 * step), c)
        d = fma(spread(x, j + 3), load(matrix, at + 3 * step), d)
    return (a + b) + (c + d)


@kernel
def _product(rows, matrix):
    """rows [n, m] times matrix [m, width], m a multiple of four."""
    out = np.empty((len(rows), matrix.shape[1]), np.float32)
    for i in prange(len(rows)):
        for at in range(0, matrix.shape[1], LANES):
            store(out, i * matrix.shape[1] + at, _times(rows[i], len(matrix), matrix, at, splat(ZERO)))
    return out


@inline
def _mixed(features, encodings, images, cover, weights, by_input, bias, i, f, s, g):
    """Fill the padded rows f (features), s (shape) and g (gate) of Gaussian i; is it covered?"""
    channels, width = features.shape[1], len(bias)
    for c in range(channels):
        f[c] = features[i, c]
    covered = cover[i, 0] >= 0
    for at in range(0, width, LANES):
        shape, power = splat(ZERO), load(bias, at)
        for k in range(cover.shape[1]):
            if cover[i, k] >= 0:
                offset, weight = cover[i, k] * width + at, splat(weights[i, k])
                shape, power = fma(weight, load(encodings, offset), shape), fma(weight, load(images, offset), power)
        power = splat(MINUS_LOG2E) * _times(f, width, by_input, at, power)
        share = splat(ONE) / (splat(ONE) + exp2(where(power > splat(LARGE), splat(LARGE), power)))
        store(s, at, shape)
        store(g, at, share if covered else splat(ONE))
    return covered


@kernel
def _forward(features, encodings, images, cover, weights, index, by_input, bias):
    channels, width = features.shape[1], len(bias)
    out = np.empty((len(index), channels), np.float32)
    for block in prange(N_BLOCKS):
        rows = np.zeros((3, width), np.float32)
        f, s, g = rows[0], rows[1], rows[2]
        for v in range(block * len(index) // N_BLOCKS, (block + 1) * len(index) // N_BLOCKS):
            _mixed(features, encodings, images, cover, weights, by_input, bias, index[v], f, s, g)
            for c in range(channels):
                out[v, c] = g[c] * f[c] + (ONE - g[c]) * s[c]
    return out


@kernel
def _backward(features, encodings, images, cover, weights, index, by_input, bias, by_output, slot, n_fresh, grad):
    """Gradients to features [N, C] and, as sums by block, to the regions' images, to the fresh encodings but for what
    their images pass on, and to the gate's matrix for features and its bias.

    by_output is that matrix [C, C] padded, by_input its transpose; slot [M] the row of a region among the fresh ones,
    -1 where it has none.
    """
    channels, width = features.shape[1], len(bias)
    to_features = np.empty((len(features), channels), np.float32)
    to_images = np.zeros((N_BLOCKS, len(encodings), width), np.float32)
    to_fresh = np.zeros((N_BLOCKS, n_fresh, width), np.float32)
    to_matrix, to_bias = np.zeros((N_BLOCKS, width, width), np.float32), np.zeros((N_BLOCKS, width), np.float32)
    for i in prange(len(features)):
        to_features[i] = ZERO
    for block in prange(N_BLOCKS):
        rows = np.zeros((6, width), np.float32)
        f, s, g, upper, slope, inward = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
        for v in range(block * len(index) // N_BLOCKS, (block + 1) * len(index) // N_BLOCKS):
            i = index[v]
            covered = _mixed(features, encodings, images, cover, weights, by_input, bias, i, f, s, g)
            for c in range(channels):
                upper[c] = grad[v, c]
            if not covered:
                to_features[i] = upper[:channels]
                continue
            for at in range(0, width, LANES):
                share, up = load(g, at), load(upper, at)
                down = up * (load(f, at) - load(s, at)) * share * (splat(ONE) - share)
                store(slope, at, down)
                store(to_bias, block * width + at, load(to_bias, block * width + at) + down)
                for j in range(width):
                    offset = (block * width + j) * width + at
                    store(to_matrix, offset, fma(spread(f, j), down, load(to_matrix, offset)))
                for k in range(cover.shape[1]):
                    if cover[i, k] >= 0:
                        weight, offset = splat(weights[i, k]), (block * len(encodings) + cover[i, k]) * width + at
                        store(to_images, offset, fma(weight, down, load(to_images, offset)))
                        if slot[cover[i, k]] >= 0:
                            offset = (block * n_fresh + slot[cover[i, k]]) * width + at
                            store(to_fresh, offset, fma(weight, up * (splat(ONE) - share), load(to_fresh, offset)))
            for at in range(0, width, LANES):
                store(inward, at, _times(slope, width, by_output, at, load(upper, at) * load(g, at)))
            to_features[i] = inward[:channels]
    return to_features, to_images, to_fresh, to_matrix, to_bias


def _padded(array: Tensor, *shape: int) -> np.ndarray:
    """float32 zeros of a shape with the array in their first corner."""
    out = np.zeros(shape, np.float32)
    out[tuple(slice(n) for n in array.shape)] = array.detach().numpy()
    return out


class _Fuse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features, fresh, matrix, bias, cache, chosen, cover, weights, index):
        channels = features.shape[1]
        width = -(-channels // LANES) * LANES
        encodings = _padded(cache, -(-len(cache) // 4) * 4, width)
        encodings[chosen.numpy(), :channels] = fresh.detach().numpy()
        ctx.of_shape, ctx.of_features = (_padded(half, width, width) for half in matrix.split(channels, 1))
        ctx.arrays = (
            features.detach().contiguous().numpy(),
            encodings,
            _product(encodings, np.ascontiguousarray(ctx.of_shape.T)),
            cover.numpy(),
            weights.numpy(),
            index.numpy(),
            np.ascontiguousarray(ctx.of_features.T),
            _padded(bias, width),
        )
        ctx.chosen = chosen.numpy()
        return torch.from_numpy(_forward(*ctx.arrays))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        features, encodings = ctx.arrays[:2]
        channels = features.shape[1]
        slot = np.full(len(encodings), -1)
        slot[ctx.chosen] = np.arange(len(ctx.chosen))
        to_features, *by_block = _backward(
            *ctx.arrays, ctx.of_features, slot, len(ctx.chosen), grad.contiguous().numpy()
        )
        to_images, to_fresh, to_matrix, to_bias = (blocks.sum(0) for blocks in by_block)
        to_fresh += _product(to_images[ctx.chosen], ctx.of_shape)
        halves = _product(np.ascontiguousarray(to_images.T), encodings), to_matrix.T
        to_matrix = np.concatenate([half[:channels, :channels] for half in halves], 1)
        grads = to_features, to_fresh[:, :channels], to_matrix, to_bias[:channels]
        return *(torch.from_numpy(array) for array in grads), None, None, None, None, None


def fuse_in_view(
    linear: nn.Linear,
    features: Tensor,
    encodings: tuple[Tensor, Tensor, Tensor],
    cover: Tensor,
    weights: Tensor,
    index: Tensor,
) -> Tensor:
    """As `fusion.fuse_in_view`, of float32 on the CPU; linear: the gate's."""
    cache, fresh, chosen = encodings
    fused: Tensor = _Fuse.apply(features, fresh, linear.weight, linear.bias, cache, chosen, cover, weights, index)
    return fused
