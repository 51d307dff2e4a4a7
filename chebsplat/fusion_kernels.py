"""Propagation and gate (Eqs 9-10) of the Gaussians in view in one sweep, in numba.

Twin of `fusion.propagate` and `fusion.Gate`, which are its oracles. Sums run in a fixed order, so the gradients are the
same bits for any number of threads; plain indexing would add them up in the order in which threads arrive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.fusion import Gate
from chebsplat.jit import inline, kernel, prange
from chebsplat.simd import exp2, fma, load, splat, spread, store, where

LANES = 16
N_BLOCKS = 32  # of the Gaussians in view, each with sums of its own
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


@inline
def _mixed(features, encodings, cover, weights, by_input, bias, i, f, s, g, x):
    """Fill the padded rows f (features), s (shape) and g (gate) of Gaussian i, and x = [s, f]; is it covered?"""
    channels, width = features.shape[1], len(bias)
    for c in range(channels):
        f[c] = features[i, c]
    for at in range(0, width, LANES):
        total = splat(ZERO)
        for k in range(cover.shape[1]):
            if cover[i, k] >= 0:
                total = fma(splat(weights[i, k]), load(encodings, cover[i, k] * width + at), total)
        store(s, at, total)
        store(x, at, total)
        store(x, width + at, load(f, at))
    covered = cover[i, 0] >= 0
    for at in range(0, width, LANES):
        power = splat(MINUS_LOG2E) * _times(x, 2 * width, by_input, at, load(bias, at))
        share = splat(ONE) / (splat(ONE) + exp2(where(power > splat(LARGE), splat(LARGE), power)))
        store(g, at, share if covered else splat(ONE))
    return covered


@kernel
def _forward(features, encodings, cover, weights, index, by_input, bias):
    channels, width = features.shape[1], len(bias)
    out = np.empty((len(index), channels), np.float32)
    for block in prange(N_BLOCKS):
        rows, x = np.zeros((3, width), np.float32), np.empty(2 * width, np.float32)
        f, s, g = rows[0], rows[1], rows[2]
        for v in range(block * len(index) // N_BLOCKS, (block + 1) * len(index) // N_BLOCKS):
            _mixed(features, encodings, cover, weights, by_input, bias, index[v], f, s, g, x)
            for c in range(channels):
                out[v, c] = g[c] * f[c] + (ONE - g[c]) * s[c]
    return out


@kernel
def _backward(features, encodings, cover, weights, index, by_input, bias, by_output, slot, n_fresh, grad):
    """Gradients to features [N, C] and, as sums by block, to the fresh encodings, the gate's weights and its bias.

    by_output is the gate's matrix [C, 2 C] padded, by_input its transpose; slot [M] the row of a region among the
    fresh ones, -1 where it has none.
    """
    channels, width = features.shape[1], len(bias)
    to_features = np.empty((len(features), channels), np.float32)
    to_fresh = np.zeros((N_BLOCKS, n_fresh, width), np.float32)
    to_gate = np.zeros((N_BLOCKS, 2 * width, width), np.float32)
    to_bias = np.zeros((N_BLOCKS, width), np.float32)
    for i in prange(len(features)):
        to_features[i] = ZERO
    for block in prange(N_BLOCKS):
        rows, x, inward = (
            np.zeros((5, width), np.float32),
            np.empty(2 * width, np.float32),
            np.empty(2 * width, np.float32),
        )
        f, s, g, upper, slope = rows[0], rows[1], rows[2], rows[3], rows[4]
        for v in range(block * len(index) // N_BLOCKS, (block + 1) * len(index) // N_BLOCKS):
            i = index[v]
            covered = _mixed(features, encodings, cover, weights, by_input, bias, i, f, s, g, x)
            for c in range(channels):
                upper[c] = grad[v, c]
            if not covered:
                to_features[i] = upper[:channels]
                continue
            for at in range(0, width, LANES):
                share, up = load(g, at), load(upper, at)
                store(slope, at, up * (load(f, at) - load(s, at)) * share * (splat(ONE) - share))
                store(inward, at, up * (splat(ONE) - share))
                store(inward, width + at, up * share)
            for at in range(0, 2 * width, LANES):
                store(inward, at, _times(slope, width, by_output, at, load(inward, at)))
            for at in range(0, width, LANES):
                down = load(slope, at)
                place = block * width + at
                store(to_bias, place, load(to_bias, place) + down)
                for j in range(2 * width):
                    place = (block * 2 * width + j) * width + at
                    store(to_gate, place, fma(spread(x, j), down, load(to_gate, place)))
                for k in range(cover.shape[1]):
                    if cover[i, k] >= 0 and slot[cover[i, k]] >= 0:
                        place = (block * n_fresh + slot[cover[i, k]]) * width + at
                        store(to_fresh, place, fma(splat(weights[i, k]), load(inward, at), load(to_fresh, place)))
            to_features[i] = inward[width : width + channels]
    return to_features, to_fresh, to_gate, to_bias


def _padded(array: Tensor, *shape: int) -> np.ndarray:
    """float32 zeros of a shape with the array in their first corner."""
    out = np.zeros(shape, np.float32)
    out[tuple(slice(n) for n in array.shape)] = array.detach().numpy()
    return out


class _Fuse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features, fresh, matrix, bias, cache, chosen, cover, weights, index):  # type: ignore[no-untyped-def, override]
        channels = features.shape[1]
        width = -(-channels // LANES) * LANES
        encodings = _padded(cache, len(cache), width)
        encodings[chosen.numpy(), :channels] = fresh.detach().numpy()
        by_output = np.zeros((width, 2, width), np.float32)
        by_output[:channels, :, :channels] = matrix.detach().reshape(channels, 2, channels).numpy()
        by_output = by_output.reshape(width, 2 * width)
        ctx.arrays = (
            features.detach().contiguous().numpy(),
            encodings,
            cover.numpy(),
            weights.numpy(),
            index.numpy(),
            np.ascontiguousarray(by_output.T),
            _padded(bias, width),
        )
        ctx.by_output, ctx.chosen = by_output, chosen.numpy()
        return torch.from_numpy(_forward(*ctx.arrays))

    @staticmethod
    def backward(ctx: Any, grad):  # type: ignore[no-untyped-def, override]
        features, encodings = ctx.arrays[:2]
        channels, width = features.shape[1], encodings.shape[1]
        slot = np.full(len(encodings), -1)
        slot[ctx.chosen] = np.arange(len(ctx.chosen))
        found = _backward(*ctx.arrays, ctx.by_output, slot, len(ctx.chosen), grad.contiguous().numpy())
        to_features, to_fresh, to_gate, to_bias = (torch.from_numpy(a) for a in found)
        to_matrix = to_gate.sum(0).reshape(2, width, width)[:, :channels, :channels].permute(2, 0, 1).flatten(1)
        parts = to_features, to_fresh.sum(0)[:, :channels], to_matrix, to_bias.sum(0)[:channels]
        return *parts, None, None, None, None, None


def fuse_in_view(
    gate: Gate,
    features: Tensor,
    encodings: tuple[Tensor, Tensor, Tensor],
    cover: Tensor,
    weights: Tensor,
    index: Tensor,
) -> Tensor:
    """Fused features [V, C] of the Gaussians `index` i64 [V] (no row twice).

    Args: features [N, C]; encodings: of all regions [M, C], without a gradient, and fresh ones [R, C], with one, that
      take the place of rows i64 [R] of the former (none twice); cover i64 [N, k] and weights [N, k] of
      `fusion.propagation_weights`.
    """
    cache, fresh, chosen = encodings
    linear = gate.linear
    return _Fuse.apply(features, fresh, linear.weight, linear.bias, cache, chosen, cover, weights, index)
