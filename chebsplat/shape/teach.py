"""Teaching the point encoder: the multi-view features of many rooms, by geometry alone (docs/method.md, section 14)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from chebsplat.shape.point_encoder import Cloud, PointEncoder

LEAST_VIEWS = 2  # that a point to learn from was seen in
WARM_UP = 50  # steps


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
