"""The local encoder: a region of Gaussians in, one semantic vector out (Eq 7)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

N_FREQUENCIES = 4


def positional_encoding(positions: Tensor) -> Tensor:
    """Positions and their sines and cosines at octaves, [..., p] -> [..., p + 2 p N_FREQUENCIES]."""
    angles = torch.cat([positions * (math.pi * 2.0**k) for k in range(N_FREQUENCIES)], -1)
    return torch.cat([positions, angles.sin(), angles.cos()], -1)


class Standardize(nn.Module):
    """Every input less its mean, over its deviation, within ±5; constants, no weights.

    Choices: a LayerNorm over a token's inputs would compare its descriptor's degrees with one another: their means
      differ by more than they vary from one Gaussian to the next, and semantic features beside them are drowned.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, n_inputs: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("deviation", torch.ones(n_inputs))

    def set(self, first: int, mean: Tensor, deviation: Tensor) -> None:
        """The constants [k] of inputs `first`, `first + 1`, ..."""
        columns = slice(first, first + len(mean))
        self.mean[columns], self.deviation[columns] = mean, deviation.clamp_min(1e-6)

    def forward(self, inputs: Tensor) -> Tensor:
        return ((inputs - self.mean) / self.deviation).clamp(-5, 5)


class Attention(nn.Module):
    """Multi-head self-attention whose padded keys get no weight.

    Choices: weights start at a deviation of 0.02: what is learned outweighs what was drawn.
    """

    def __init__(self, width: int, n_heads: int):
        super().__init__()
        if width % n_heads:
            raise ValueError(f"width {width} is not a multiple of n_heads {n_heads}")
        self.n_heads = n_heads
        self.query, self.key, self.value, self.output = (nn.Linear(width, width) for _ in range(4))
        for part in (self.query, self.key, self.value, self.output):
            nn.init.normal_(part.weight, std=0.02)

    def forward(self, tokens: Tensor, mask: Tensor, wanted: int) -> Tensor:
        """tokens [M, n, width], mask [M, n] true where a token exists -> [M, wanted, width], of the first tokens."""
        asking = tokens[:, :wanted]
        q, k, v = self._heads(self.query(asking)), self._heads(self.key(tokens)), self._heads(self.value(tokens))
        scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
        weights = scores.masked_fill(~mask[:, None, None, :], -1e9).softmax(-1)
        mixed: Tensor = self.output((weights @ v).transpose(1, 2).reshape(asking.shape))
        return mixed

    def _heads(self, values: Tensor) -> Tensor:
        """[M, n, width] -> [M, heads, n, width / heads]."""
        shape = (*values.shape[:2], self.n_heads, values.shape[2] // self.n_heads)
        return values.reshape(shape).transpose(1, 2)


class Block(nn.Module):
    """Pre-norm attention and feed-forward, each with its residual; of the first `wanted` tokens, which see all."""

    def __init__(self, width: int, n_heads: int):
        super().__init__()
        self.norm_attention, self.norm_forward = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = Attention(width, n_heads)
        self.forward_1, self.forward_2 = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, tokens: Tensor, mask: Tensor, wanted: int) -> Tensor:
        tokens = tokens[:, :wanted] + self.attention(self.norm_attention(tokens), mask, wanted)
        mixed: Tensor = tokens + self.forward_2(nn.functional.gelu(self.forward_1(self.norm_forward(tokens))))
        return mixed


class RegionEncoder(nn.Module):
    """Tokens of a region's Gaussians, a learned region token, a transformer, and an MLP on the region token.

    Args:
      n_inputs:   width of a token's input: flattened descriptor, context, or both; 0 for positions alone.
      n_channels: width of the semantic features.
      n_positions: numbers that say where a token lies: 3, or 6.
      n_layers:   0 replaces attention by a maximum over tokens (the paper's ablation without the transformer).
    Choices: pre-norm, with an output map and feed-forward; each input is standardised; a region without members
      gives a finite vector that nothing reads.
    """

    def __init__(
        self,
        n_inputs: int,
        n_channels: int,
        width: int = 32,
        n_layers: int = 2,
        n_heads: int = 4,
        n_positions: int = 3,
    ):
        super().__init__()
        self.n_inputs, self.n_channels, self.n_positions = n_inputs, n_channels, n_positions
        self.settings = {"width": width, "n_layers": n_layers, "n_heads": n_heads, "n_positions": n_positions}
        self.embed_position = nn.Linear(n_positions * (1 + 2 * N_FREQUENCIES), width)
        if n_inputs:
            self.norm_input = Standardize(n_inputs)
            self.embed_input = nn.Linear(n_inputs, width)
        self.hidden = nn.Linear(width, width)
        self.region_token = nn.Parameter(torch.zeros(width))
        self.blocks = nn.ModuleList(Block(width, n_heads) for _ in range(n_layers))
        self.norm = nn.LayerNorm(width)
        self.decode = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, n_channels))

    def forward(self, inputs: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Encode regions.

        Args:
          inputs:    [M, n, n_inputs]; ignored where n_inputs is 0.
          positions: [M, n, n_positions], see `region_inputs.placed`.
          mask:      [M, n] bool, true where a member exists.
        Returns: [M, n_channels].
        """
        tokens = self.embed_position(positional_encoding(positions))
        if self.n_inputs:
            tokens = tokens + self.embed_input(self.norm_input(inputs))
        tokens = self.hidden(nn.functional.gelu(tokens))
        if not self.blocks:
            pooled = tokens.masked_fill(~mask[..., None], -1e9).amax(1)
            present = mask.any(1, keepdim=True)
            pooled = torch.where(present, pooled, torch.zeros_like(pooled))
            encodings: Tensor = self.decode(self.norm(pooled))
            return encodings
        region = self.region_token.expand(tokens.shape[0], 1, -1)
        tokens = torch.cat([region, tokens], 1)
        mask = torch.cat([torch.ones_like(mask[:, :1]), mask], 1)
        for depth, block in enumerate(self.blocks, 1):  # only the region token is read: the last block makes no other
            tokens = block(tokens, mask, 1 if depth == len(self.blocks) else tokens.shape[1])
        encodings = self.decode(self.norm(tokens[:, 0]))
        return encodings

    @classmethod
    def restored(cls, settings: dict[str, int], weights: dict[str, np.ndarray]) -> RegionEncoder:
        """The encoder of a checkpoint: constructor settings, and weights by name. Raises RuntimeError on a misfit."""
        encoder = cls(**settings)
        encoder.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
        return encoder.eval()
