"""The point encoder: a point's surroundings at several radii in, features of its shape out (Eq 7).

It sees geometry alone and is trained once (`train_encoder`), over many rooms, so that it cannot
repeat what a 2D teacher gets wrong for reasons of texture or of view. From then on it stays as it
is: what its features mean, scenes teach by sums (`shape.lessons`; docs/method.md, section 14).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.shape.lessons import odds
from chebsplat.shape.point_inputs import N_OWN, RADII, PointInputs

N_RELATIVE = 10
N_HEADS = 4
CHUNK = 1024  # points encoded at once
WARM_UP = 50  # steps


class Cloud(NamedTuple):
    """`PointInputs` as tensors; neighbors i64."""

    own: Tensor
    means: Tensor
    normals: Tensor
    descriptors: Tensor
    neighbors: Tensor


def cloud_of(inputs: PointInputs) -> Cloud:
    """Tensors of the arrays; they share memory."""
    own, means, normals, descriptors = (torch.from_numpy(v) for v in inputs[:4])
    return Cloud(
        own, means, normals, descriptors, torch.from_numpy(inputs.neighbors.astype(np.int64))
    )


class Standardize(nn.Module):
    """Every input less its mean, over its deviation, within ±5; constants, no weights.

    Choices: a LayerNorm over a point's descriptor would compare its degrees with one another: their
      means differ by more than they vary from one point to the next.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, n_inputs: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("deviation", torch.ones(n_inputs))

    def set(self, mean: Tensor, deviation: Tensor) -> None:
        """The constants [n] of all inputs."""
        self.mean[:], self.deviation[:] = mean, deviation.clamp_min(1e-6)

    def forward(self, inputs: Tensor) -> Tensor:
        return ((inputs - self.mean) / self.deviation).clamp(-5, 5)


class Scale(nn.Module):
    """One radius: a learned token attends to the neighbours' tokens (Eq 7), and beside it stands
    the mean of these.

    Choices: a neighbour's token is f(G_i) + PE(c_i): its embedding and the point's own, and where
      it lies. One block, normalised before; only the learned token is read of its attention, so
      that one query a head asks every point, and keys and values need no matrix a neighbour. Where
      a radius is empty the token attends to itself alone. Without attention, to measure it by,
      the largest of the tokens stands in the learned one's place.
    """

    def __init__(self, width: int, hidden: int, attends: bool = True):
        super().__init__()
        self.attends = attends
        self.token = nn.Parameter(torch.randn(hidden) / hidden**0.5)
        self.point, self.neighbor = nn.Linear(width, hidden), nn.Linear(width, hidden, bias=False)
        self.place = nn.Sequential(
            nn.Linear(N_RELATIVE, hidden), nn.SiLU(), nn.Linear(hidden, hidden, bias=False)
        )
        self.norm, self.norm_after = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.query, self.key = (nn.Linear(hidden, hidden, bias=False) for _ in range(2))
        self.value, self.out = (nn.Linear(hidden, hidden, bias=False) for _ in range(2))
        self.feed = nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden))

    def project_query(self) -> Tensor:
        """[h, heads]: W_kᵀ of each head's part of the learned token's query, over √(h / heads)."""
        query = self.query(self.norm(self.token)).reshape(N_HEADS, -1)
        keys = self.key.weight.reshape(N_HEADS, -1, self.key.in_features)
        projected: Tensor = torch.einsum("hq,hqd->dh", query, keys) / query.shape[1] ** 0.5
        return projected

    def project_values(self) -> Tensor:
        """[heads, h, h], W_o W_v: from the tokens that a head gathers to its part of the output."""
        values = self.value.weight.reshape(N_HEADS, -1, self.value.in_features)
        out = self.out.weight.reshape(self.out.out_features, N_HEADS, -1)
        projected: Tensor = torch.einsum("hqd,ohq->hdo", values, out)
        return projected

    def forward(
        self, embedded: Tensor, centers: Tensor, neighbors: Tensor, relative: Tensor
    ) -> Tensor:
        """embedded [U, width] and its rows centers [B] and neighbors [B, K], -1: none, with
        relative [B, K, 10] -> [B, 2 h].
        """
        present, rows = neighbors >= 0, neighbors.clamp_min(0)
        tokens = (
            self.point(embedded[centers])[:, None]
            + self.neighbor(embedded)[rows]
            + self.place(relative)
        )
        fed = (tokens + self.feed(self.norm_after(tokens))) * present[..., None]
        mean = fed.sum(1) / present.sum(1, keepdim=True).clamp_min(1)
        if not self.attends:
            largest = fed.masked_fill(~present[..., None], -1e9).amax(1)
            return torch.cat([torch.where(present.any(1, keepdim=True), largest, 0.0), mean], 1)
        normal, own = self.norm(tokens), self.norm(self.token)
        scores = (normal @ self.project_query()).masked_fill(~present[..., None], -math.inf)
        scores = torch.cat(
            [scores, (own @ self.project_query()).expand(len(scores), 1, -1)], 1
        ).softmax(1)
        # [B, heads, h]
        gathered = scores[:, :-1].transpose(1, 2) @ normal + scores[:, -1, :, None] * own
        token = self.token + torch.einsum("bhd,hdo->bo", gathered, self.project_values())
        token = token + self.feed(self.norm_after(token))
        return torch.cat([token, mean], 1)


class PointEncoder(nn.Module):
    """Features z of a point's shape and, in training, a teacher's features of such a point.

    Args:
      n_descriptors: values of a point's descriptors over all radii; 0: it sees none.
      n_components:  that these are reduced to, whitened (`set_inputs`).
      n_channels:    of the teacher; n_scales: radii, the first of `RADII`.
      attends:       false: neighbours are pooled, not attended to.
    Choices: z holds what the decoder sees and its last layer: the one carries over to other worlds
      better, the other is better within one. A last 1 makes room for a constant.
    """

    components: Tensor

    def __init__(
        self,
        n_channels: int,
        n_descriptors: int,
        n_components: int = 48,
        width: int = 48,
        hidden: int = 64,
        n_scales: int = len(RADII),
        attends: bool = True,
    ):
        super().__init__()
        n_components = min(n_components, n_descriptors)
        self.settings = {
            "n_channels": n_channels,
            "n_descriptors": n_descriptors,
            "n_components": n_components,
        }
        self.settings |= {
            "width": width,
            "hidden": hidden,
            "n_scales": n_scales,
            "attends": attends,
        }
        self.norm_own, self.norm_descriptors = Standardize(N_OWN), Standardize(n_descriptors)
        self.register_buffer("components", torch.zeros(n_descriptors, n_components))
        self.embed = nn.Sequential(
            nn.Linear(N_OWN + n_components, 64), nn.SiLU(), nn.Linear(64, width)
        )
        self.scales = nn.ModuleList(Scale(width, hidden, attends) for _ in range(n_scales))
        total = width + 2 * hidden * n_scales
        self.decode = nn.Sequential(nn.Linear(total, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU())
        self.head = nn.Linear(96, n_channels)
        self.n_features = total + 96 + 1

    @torch.no_grad()
    def set_inputs(self, clouds: list[Cloud], sample: int = 11) -> None:
        """Constants of the inputs, from every `sample`-th point: means, deviations, and the
        descriptors' principal directions, each scaled to a deviation of 1.
        """
        own = torch.cat([cloud.own[::sample] for cloud in clouds])
        self.norm_own.set(own.mean(0), own.std(0))
        if not self.settings["n_descriptors"]:
            return
        descriptors = torch.cat([cloud.descriptors[::sample] for cloud in clouds])
        self.norm_descriptors.set(descriptors.mean(0), descriptors.std(0))
        standard = self.norm_descriptors(descriptors).double()
        values, axes = torch.linalg.eigh(standard.T @ standard / len(standard))
        count = self.settings["n_components"]
        directions = axes.flip(1)[:, :count] / values.flip(0)[:count].clamp_min(1e-6).sqrt()
        signs = torch.where(directions.gather(0, directions.abs().argmax(0)[None]) < 0, -1.0, 1.0)
        self.components.copy_(directions * signs)

    def embedded(self, own: Tensor, descriptors: Tensor) -> Tensor:
        """[U, width] of points by themselves."""
        parts = [self.norm_own(own)]
        if self.settings["n_descriptors"]:
            parts.append(self.norm_descriptors(descriptors) @ self.components)
        embedded: Tensor = self.embed(torch.cat(parts, 1))
        return embedded

    def forward(self, cloud: Cloud, embedded: Tensor, centers: Tensor, neighbors: Tensor) -> Tensor:
        """z [B, p] for rows `centers` [B]; `neighbors` [B, S, K]: rows of cloud and `embedded`."""
        parts = [embedded[centers]]
        for index, scale in enumerate(self.scales):
            rows = neighbors[:, index]
            parts.append(
                scale(embedded, centers, rows, relative(cloud, centers, rows, RADII[index]))
            )
        features = torch.cat(parts, 1)
        return torch.cat([features, self.decode(features), torch.ones(len(features), 1)], 1)

    def answers(self, features: Tensor) -> Tensor:
        """Features [B, C] that the encoder's teacher gives points with features z [B, p]."""
        answer: Tensor = self.head(features[:, -1 - self.head.in_features : -1])
        return answer

    @torch.no_grad()
    def encode(self, inputs: PointInputs, rows: np.ndarray | None = None) -> np.ndarray:
        """z f32 [N, p] of these points, all by default."""
        cloud = cloud_of(inputs)
        centers = torch.arange(len(cloud.own)) if rows is None else torch.from_numpy(rows)
        embedded = self.embedded(cloud.own, cloud.descriptors)
        parts = [torch.zeros(0, self.n_features)]
        parts += [
            self(cloud, embedded, some, cloud.neighbors[some]) for some in centers.split(CHUNK)
        ]
        return torch.cat(parts).numpy()

    @classmethod
    def restored(cls, settings: dict[str, Any], weights: dict[str, np.ndarray]) -> PointEncoder:
        """Constructor settings, and weights by name; the head, which only teaching needs, may be
        missing. Raises RuntimeError on a misfit.
        """
        encoder = cls(**settings)
        missing, extra = encoder.load_state_dict(
            {n: torch.from_numpy(v) for n, v in weights.items()}, strict=False
        )
        if extra or any(not name.startswith("head.") for name in missing):
            raise RuntimeError(f"weights do not fit the encoder: {[*missing, *extra][0]}")
        return encoder.eval()


def relative(cloud: Cloud, centers: Tensor, neighbors: Tensor, radius: float) -> Tensor:
    """Places of neighbours [B, K] about points [B], in radii: [B, K, N_RELATIVE].

    Args: neighbors: rows of the cloud; -1 is none, whose values mean nothing; radius: metres.

    Choices: the offset itself, its length, its length in the horizontal and its height's size;
      along the point's normal and across it; the product of both normals, and the difference of
      normal · up. Teaching turns rooms about the vertical, so that the offset's direction there
      is random.
    """
    rows = neighbors.clamp_min(0)
    offset = (cloud.means[rows] - cloud.means[centers][:, None]) / radius
    normal, others = cloud.normals[centers][:, None], cloud.normals[rows]
    along = (offset * normal).sum(-1, keepdim=True)
    parts = [
        offset,
        offset.norm(dim=-1, keepdim=True),
        offset[..., :2].norm(dim=-1, keepdim=True),
        offset[..., 2:].abs(),
        along,
        (offset - along * normal).norm(dim=-1, keepdim=True),
        (normal * others).sum(-1, keepdim=True),
        others[..., 2:] - normal[..., 2:],
    ]
    return torch.cat(parts, -1)


@dataclass
class Example:
    """A room to learn from: its cloud of N points, the mean of a teacher's unit features over the
    views that see a point [N, C], how many these are [N], and the label that the teacher gives it
    [N], by which rare things are drawn more often.
    """

    cloud: Cloud
    features: Tensor
    n_views: np.ndarray
    labels: np.ndarray


@dataclass(frozen=True)
class Course:
    """Settings of the encoder's training."""

    steps: int = 3000
    batch: int = 640
    n_neighbors: int = 12  # of those that a cloud has, drawn anew at every step
    rate: float = 2e-3
    decay: float = 1e-3
    seed: int = 0


def train_encoder(
    encoder: PointEncoder, examples: list[Example], course: Course
) -> Iterator[float]:
    """Train in place; yields the loss of each step, the mean distance to a teacher's mean features.

    Choices: one room a step, turned about the vertical and mirrored at random. AdamW, half a
      cosine.
    """
    torch.manual_seed(course.seed)
    rng = np.random.default_rng(course.seed)
    drawn = [odds(example.n_views, example.labels) for example in examples]
    optimizer = torch.optim.AdamW(encoder.parameters(), lr=course.rate, weight_decay=course.decay)
    for step in range(course.steps):
        fraction = 0.5 * (1 + math.cos(math.pi * step / course.steps))
        optimizer.param_groups[0]["lr"] = course.rate * min(1.0, (step + 1) / WARM_UP) * fraction
        index = int(rng.integers(len(examples)))
        example = examples[index]
        rows = torch.from_numpy(rng.choice(len(drawn[index]), course.batch, p=drawn[index]))
        columns = np.sort(rng.permutation(example.cloud.neighbors.shape[2])[: course.n_neighbors])
        part, centers, neighbors = excerpt(example.cloud, rows, torch.from_numpy(columns))
        part = turned(part, rng.uniform(0, 2 * math.pi), mirrored=bool(rng.random() < 0.5))
        answers = encoder.answers(
            encoder(part, encoder.embedded(part.own, part.descriptors), centers, neighbors)
        )
        loss = (answers - example.features[rows]).norm(dim=1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield float(loss.detach())


def excerpt(cloud: Cloud, rows: Tensor, columns: Tensor) -> tuple[Cloud, Tensor, Tensor]:
    """The points `rows` [B] and their neighbours in `columns` [k], each once.

    Returns: the cloud of these; which of its rows the points are [B]; and their neighbours,
             rows of it too, [B, S, k], -1 none.
    """
    neighbors = cloud.neighbors[rows][:, :, columns]
    present = neighbors >= 0
    distinct, inverse = torch.cat([rows, neighbors[present]]).unique(return_inverse=True)
    renumbered = torch.full_like(neighbors, -1)
    renumbered[present] = inverse[len(rows) :]
    own, means, normals, descriptors = (values[distinct] for values in cloud[:4])
    part = Cloud(own, means, normals, descriptors, renumbered)
    return part, inverse[: len(rows)], renumbered


def turned(cloud: Cloud, angle: float, *, mirrored: bool) -> Cloud:
    """The cloud turned by an angle [rad] about the vertical; mirrored in x before, if at all."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=cloud.means.dtype)
    if mirrored:
        turn = turn * torch.tensor([-1.0, 1.0, 1.0], dtype=cloud.means.dtype)
    return cloud._replace(means=cloud.means @ turn.T, normals=cloud.normals @ turn.T)
