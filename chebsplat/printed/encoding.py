"""Transformer-based local encoding: a region's tokens in, one vector p(S) out (Eq 7).

The print names neither PE nor the blocks' normalisation: octaves of sines and cosines, and a
LayerNorm before each half of a block, whose result is added to what came in.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def positional_encoding(centers: Tensor, width: int) -> Tensor:
    """PE(c) of centres [..., 3]: sines and cosines at octaves, cut at `width`."""
    n_octaves = math.ceil(width / 6)
    parts = []
    for octave in range(n_octaves):
        turns = centers * (2.0**octave * math.pi)
        parts += [turns.sin(), turns.cos()]
    return torch.cat(parts, -1)[..., :width]


def attention(z: Tensor, Wq: Tensor, Wk: Tensor, Wv: Tensor, present: Tensor) -> Tensor:
    """Concat over heads of sum_j softmax(q_h . k_j / sqrt(d)) v_j, [..., t, m d] (Eq 7).

    Args: z [..., t, Q]; Wq, Wk, Wv [m, Q, d], of each head its own; present [..., t]: absent tokens
      get no weight.
    """
    q, k, v = (torch.einsum("...tq,mqd->...mtd", z, W) for W in (Wq, Wk, Wv))
    scores = q @ k.mT / math.sqrt(Wq.shape[-1])
    scores = scores.masked_fill(~present[..., None, None, :], -torch.inf)
    mixed = scores.softmax(-1) @ v
    return mixed.transpose(-3, -2).flatten(-2)


class Layer(nn.Module):
    """Self-attention, then feed-forward. d = Q / m, so that Concat has the width of z."""

    def __init__(self, width: int, n_heads: int):
        super().__init__()
        if width % n_heads:
            raise ValueError(f"width {width} is not a multiple of n_heads {n_heads}")
        self.norm_attention, self.norm_forward = nn.LayerNorm(width), nn.LayerNorm(width)
        shape = n_heads, width, width // n_heads
        scale = width**-0.5
        self.query = nn.Parameter(torch.randn(shape) * scale)
        self.key = nn.Parameter(torch.randn(shape) * scale)
        self.value = nn.Parameter(torch.randn(shape) * scale)
        self.forward_1, self.forward_2 = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, z: Tensor, present: Tensor) -> Tensor:
        """z [..., t, Q], present [..., t] -> [..., t, Q]."""
        normed = self.norm_attention(z)
        z = z + attention(normed, self.query, self.key, self.value, present)
        hidden = nn.functional.gelu(self.forward_1(self.norm_forward(z)))
        changed: Tensor = z + self.forward_2(hidden)
        return changed


class Encoder(nn.Module):
    """p(S) = MLP(y_0) of the sequence [z_0; z_1; ...; z_n], z_i = f(G_i) + PE(c_i)."""

    def __init__(self, width: int, n_channels: int, n_layers: int, n_heads: int):
        super().__init__()
        self.token = nn.Parameter(torch.randn(width) * width**-0.5)
        self.layers = nn.ModuleList(Layer(width, n_heads) for _ in range(n_layers))
        self.head_1, self.head_2 = nn.Linear(width, width), nn.Linear(width, n_channels)

    def tokens(self, descriptors: Tensor, centers: Tensor) -> Tensor:
        """z [..., n + 1, Q] of descriptors [..., n, Q] and centres [..., n, 3], scene units."""
        z = descriptors + positional_encoding(centers, descriptors.shape[-1])
        first = self.token.expand(*z.shape[:-2], 1, -1)
        return torch.cat([first, z], -2)

    def forward(self, z: Tensor, present: Tensor) -> Tensor:
        """z [..., n + 1, Q], present [..., n] -> p(S) [..., C]."""
        present = nn.functional.pad(present, (1, 0), value=True)
        z = torch.where(present[..., None], z, 0.0)
        for layer in self.layers:
            z = layer(z, present)
        encodings: Tensor = self.head_2(nn.functional.gelu(self.head_1(z[..., 0, :])))
        return encodings

    def key_projections(self) -> dict[str, Tensor]:
        """W [Q, d] by name: what the core knowledge space keeps of the transformer."""
        kinds = ("query", "key", "value")
        return {
            f"{i}.{kind}.{head}": matrix
            for i, layer in enumerate(self.layers)
            for kind in kinds
            for head, matrix in enumerate(getattr(layer, kind))
        }


class PointMLP(nn.Module):
    """Table 5's "w/o TLE", and "w/o AGCD" with tokens of position alone: each token through an MLP.

    The print says "MLP" and no more: the mean over a region's tokens, then the encoder's own head.
    """

    def __init__(self, width: int, n_channels: int):
        super().__init__()
        self.hidden, self.mixed = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)
        self.head_1, self.head_2 = nn.Linear(width, width), nn.Linear(width, n_channels)

    def tokens(self, descriptors: Tensor, centers: Tensor) -> Tensor:
        """z [..., n, Q]; there is no learned token."""
        return descriptors + positional_encoding(centers, descriptors.shape[-1])

    def forward(self, z: Tensor, present: Tensor) -> Tensor:
        """z [..., n, Q], present [..., n] -> p(S) [..., C]."""
        each = self.mixed(nn.functional.gelu(self.hidden(z)))
        count = present.sum(-1, keepdim=True).clamp_min(1)
        mean = torch.where(present[..., None], each, 0.0).sum(-2) / count
        encodings: Tensor = self.head_2(nn.functional.gelu(self.head_1(mean)))
        return encodings

    def key_projections(self) -> dict[str, Tensor]:
        """None: there is no transformer whose matrices could be kept."""
        return {}
