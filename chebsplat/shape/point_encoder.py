"""The point encoder: what surrounds a point at several radii in, the 2D teacher's semantic vector of it out (Eq 7).

It sees geometry alone, answers for every point, and is taught (`taught`) over many rooms, so that it cannot repeat what
a teacher gets wrong for reasons of texture or of view (docs/method.md, section 14).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from chebsplat.shape.point_inputs import N_OWN, RADII, PointInputs

N_RELATIVE = 10
CHUNK = 4096  # points encoded at once
LEAST_VIEWS = 2  # that a point to learn from was seen in
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
    return Cloud(own, means, normals, descriptors, torch.from_numpy(inputs.neighbors.astype(np.int64)))


class Standardize(nn.Module):
    """Every input less its mean, over its deviation, within ±5; constants, no weights.

    Choices: a LayerNorm over a point's descriptor would compare its degrees with one another: their means differ by
      more than they vary from one point to the next.
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
    """One radius: an MLP of each neighbour, then mean and maximum over them; zero where there is none."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.point, self.neighbor = nn.Linear(width, hidden), nn.Linear(width, hidden, bias=False)
        self.relative, self.mix = nn.Linear(N_RELATIVE, hidden, bias=False), nn.Linear(hidden, hidden)

    def forward(self, embedded: Tensor, centers: Tensor, neighbors: Tensor, relative: Tensor) -> Tensor:
        """embedded [U, width], centers [B], neighbors [B, K] rows of it, -1: none; relative [B, K, 10] -> [B, 2 h]."""
        present, rows = (neighbors >= 0)[..., None], neighbors.clamp_min(0)
        tokens = self.point(embedded[centers])[:, None] + self.neighbor(embedded)[rows] + self.relative(relative)
        tokens = nn.functional.silu(self.mix(nn.functional.silu(tokens)))
        mean = (tokens * present).sum(1) / present.sum(1).clamp_min(1)
        largest = tokens.masked_fill(~present, -1e9).amax(1)
        return torch.cat([mean, torch.where(present.any(1), largest, torch.zeros_like(largest))], 1)


class PointEncoder(nn.Module):
    """An answer per point.

    Args:
      n_descriptors: values of a point's descriptors over all radii; 0: it sees none.
      n_components:  that these are reduced to, whitened (`set_inputs`).
      n_channels:    of the answer; n_scales: radii, the first of `RADII`.
    Choices: pooling over neighbours, where attention gained nothing at equal seconds. The answer is the mean of unit
      vectors of a teacher over views; its length says how alike these were, and so how sure it is.
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
    ):
        super().__init__()
        n_components = min(n_components, n_descriptors)
        self.settings = {"n_channels": n_channels, "n_descriptors": n_descriptors, "n_components": n_components}
        self.settings |= {"width": width, "hidden": hidden, "n_scales": n_scales}
        self.norm_own, self.norm_descriptors = Standardize(N_OWN), Standardize(n_descriptors)
        self.register_buffer("components", torch.zeros(n_descriptors, n_components))
        self.embed = nn.Sequential(nn.Linear(N_OWN + n_components, 64), nn.SiLU(), nn.Linear(64, width))
        self.scales = nn.ModuleList(Scale(width, hidden) for _ in range(n_scales))
        total = width + 2 * hidden * n_scales
        self.decode = nn.Sequential(
            nn.Linear(total, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU(), nn.Linear(96, n_channels)
        )

    @torch.no_grad()
    def set_inputs(self, clouds: list[Cloud], sample: int = 11) -> None:
        """Constants of the inputs, from every `sample`-th point: means, deviations, and the descriptors' principal
        directions, each scaled to a deviation of 1.
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
        kept = axes.flip(1)[:, :count] / values.flip(0)[:count].clamp_min(1e-6).sqrt()
        signs = torch.where(kept.gather(0, kept.abs().argmax(0)[None]) < 0, -1.0, 1.0)
        self.components.copy_(kept * signs)

    def embedded(self, own: Tensor, descriptors: Tensor) -> Tensor:
        """[U, width] of points by themselves."""
        parts = [self.norm_own(own)]
        if self.settings["n_descriptors"]:
            parts.append(self.norm_descriptors(descriptors) @ self.components)
        embedded: Tensor = self.embed(torch.cat(parts, 1))
        return embedded

    def forward(self, cloud: Cloud, embedded: Tensor, centers: Tensor, neighbors: Tensor) -> Tensor:
        """Answers [B, C] for rows `centers` [B]; `neighbors` [B, S, K] are rows of cloud and of embedded [U, width]."""
        parts = [embedded[centers]]
        for index, scale in enumerate(self.scales):
            rows = neighbors[:, index]
            parts.append(scale(embedded, centers, rows, relative(cloud, centers, rows, RADII[index])))
        answers: Tensor = self.decode(torch.cat(parts, 1))
        return answers

    @torch.no_grad()
    def predict(self, inputs: PointInputs) -> np.ndarray:
        """Answers f32 [N, C] of all points."""
        cloud = cloud_of(inputs)
        embedded = self.embedded(cloud.own, cloud.descriptors)
        parts = [torch.zeros(0, self.settings["n_channels"])]
        for start in range(0, len(cloud.own), CHUNK):
            rows = torch.arange(start, min(start + CHUNK, len(cloud.own)))
            parts.append(self(cloud, embedded, rows, cloud.neighbors[rows]))
        return torch.cat(parts).numpy()

    @classmethod
    def restored(cls, settings: dict[str, int], weights: dict[str, np.ndarray]) -> PointEncoder:
        """Constructor settings, and weights by name. Raises RuntimeError on a misfit."""
        encoder = cls(**settings)
        encoder.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
        return encoder.eval()


def relative(cloud: Cloud, centers: Tensor, neighbors: Tensor, radius: float) -> Tensor:
    """How neighbours [B, K] lie about points [B], in radii: [B, K, 10].

    Choices: the offset itself, its length, its length in the horizontal and its height's size; along the point's normal
      and across it; the product of both normals, and the difference of normal · up. Teaching turns rooms about the
      vertical, so that the offset's direction there says nothing.
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
class Lesson:
    """A room to learn from: its cloud of N points, the mean of a teacher's unit features over the views that see a
    point [N, C], how many these are [N], and the label that the teacher gives it [N], by which rare things are drawn
    more often.
    """

    cloud: Cloud
    features: Tensor
    n_views: np.ndarray
    labels: np.ndarray

    def odds(self) -> np.ndarray:
        """How often each point is drawn: half alike, half by 1 / sqrt(frequency of its label)."""
        seen = (self.n_views >= LEAST_VIEWS).astype(np.float64)
        rare = seen / np.sqrt(np.bincount(self.labels, minlength=1)[self.labels])
        if not seen.any():
            raise ValueError(f"no point of a room is seen in {LEAST_VIEWS} views")
        return np.asarray(0.5 * seen / seen.sum() + 0.5 * rare / rare.sum())


@dataclass(frozen=True)
class Course:
    """How the encoder is taught."""

    steps: int = 3000
    batch: int = 640
    n_neighbors: int = 12  # of those that a cloud has, drawn anew at every step
    rate: float = 3e-3
    decay: float = 1e-3
    seed: int = 0


def taught(encoder: PointEncoder, lessons: list[Lesson], course: Course) -> Iterator[float]:
    """Train in place; yields the loss of each step, the mean length of the difference to the teacher's mean features.

    Choices: one room a step, turned about the vertical and mirrored at random. AdamW, half a cosine.
    """
    torch.manual_seed(course.seed)
    rng = np.random.default_rng(course.seed)
    odds = [lesson.odds() for lesson in lessons]
    optimizer = torch.optim.AdamW(encoder.parameters(), lr=course.rate, weight_decay=course.decay)
    for step in range(course.steps):
        fraction = 0.5 * (1 + math.cos(math.pi * step / course.steps))
        optimizer.param_groups[0]["lr"] = course.rate * min(1.0, (step + 1) / WARM_UP) * fraction
        index = int(rng.integers(len(lessons)))
        lesson = lessons[index]
        rows = torch.from_numpy(rng.choice(len(odds[index]), course.batch, p=odds[index]))
        chosen = np.sort(rng.permutation(lesson.cloud.neighbors.shape[2])[: course.n_neighbors])
        part, centers, neighbors = excerpt(lesson.cloud, rows, torch.from_numpy(chosen))
        part = turned(part, rng.uniform(0, 2 * math.pi), mirrored=bool(rng.random() < 0.5))
        answers = encoder(part, encoder.embedded(part.own, part.descriptors), centers, neighbors)
        loss = (answers - lesson.features[rows]).norm(dim=1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield float(loss.detach())


def excerpt(cloud: Cloud, rows: Tensor, chosen: Tensor) -> tuple[Cloud, Tensor, Tensor]:
    """The points `rows` [B] and their neighbours in columns `chosen` [k], each once; rows and neighbours in these."""
    neighbors = cloud.neighbors[rows][:, :, chosen]
    present = neighbors >= 0
    distinct, inverse = torch.cat([rows, neighbors[present]]).unique(return_inverse=True)
    renumbered = torch.full_like(neighbors, -1)
    renumbered[present] = inverse[len(rows) :]
    own, means, normals, descriptors = (values[distinct] for values in cloud[:4])
    part = Cloud(own, means, normals, descriptors, renumbered)
    return part, inverse[: len(rows)], renumbered


def turned(cloud: Cloud, angle: float, *, mirrored: bool) -> Cloud:
    """About the vertical."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=cloud.means.dtype)
    if mirrored:
        turn = turn * torch.tensor([-1.0, 1.0, 1.0], dtype=cloud.means.dtype)
    return cloud._replace(means=cloud.means @ turn.T, normals=cloud.normals @ turn.T)
