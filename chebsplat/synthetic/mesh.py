"""A triangle soup of simple solids: every triangle has a label, a material, a texture frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from chebsplat.synthetic import CLASS_NAMES


@dataclass(frozen=True)
class Frame:
    """Place of a piece of furniture: origin [3] m, turned by yaw (rad) about the vertical."""

    origin: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def rotation(self) -> np.ndarray:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def moved(self, x: float, y: float, z: float, turn: float = 0.0) -> Frame:
        """A frame at local (x, y, z), turned further."""
        where = np.asarray(self.origin) + self.rotation @ (x, y, z)
        return Frame((float(where[0]), float(where[1]), float(where[2])), self.yaw + turn)


@dataclass
class Soup:
    """vertices f32 [N, 3] m, triangles u32 [T, 3]; of each, labels and materials i16, parts i32.

    A part's texture coordinates are `rotations[part] @ (p − origins[part])`, with its longest side
    along x.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    labels: np.ndarray
    materials: np.ndarray
    parts: np.ndarray
    origins: np.ndarray
    rotations: np.ndarray


@dataclass
class Builder:
    """Collects solids; `soup()` joins them."""

    vertices: list[np.ndarray] = field(default_factory=list)
    triangles: list[np.ndarray] = field(default_factory=list)
    # label, material, number of triangles
    tags: list[tuple[int, int, int]] = field(default_factory=list)
    frames: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    count: int = 0

    def add(
        self,
        label: str | None,
        material: int,
        frame: Frame,
        vertices: np.ndarray,
        triangles: np.ndarray,
    ) -> None:
        """One solid, in the local coordinates of `frame`; label None: of no class."""
        rotation, origin = frame.rotation, np.asarray(frame.origin)
        centre = 0.5 * (vertices.min(0) + vertices.max(0))
        order = np.argsort(-np.ptp(vertices, axis=0), kind="stable")
        self.frames.append((origin + rotation @ centre, np.eye(3)[order] @ rotation.T))
        self.vertices.append(vertices @ rotation.T + origin)
        self.triangles.append(triangles + self.count)
        number = -1 if label is None else CLASS_NAMES.index(label)
        self.tags.append((number, material, len(triangles)))
        self.count += len(vertices)

    def box(
        self,
        label: str,
        material: int,
        frame: Frame,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
    ) -> None:
        """An axis-aligned box between two local corners."""
        corners = np.array([low, high], float)
        index = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        vertices = np.stack([corners[index[:, axis], axis] for axis in range(3)], 1)
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
        self.add(label, material, frame, vertices, triangles)

    def revolved(
        self,
        label: str,
        material: int,
        frame: Frame,
        profile: list[tuple[float, float]],
        n: int = 20,
    ) -> None:
        """A surface of revolution about local z through (radius, height) points, ends closed."""
        angles = np.arange(n) * (2 * np.pi / n)
        rings = [
            np.stack([r * np.cos(angles), r * np.sin(angles), np.full(n, z)], 1) for r, z in profile
        ]
        ends = np.array([[0, 0, profile[0][1]], [0, 0, profile[-1][1]]], float)
        vertices = np.concatenate([*rings, ends])
        triangles = []
        last = len(profile) * n
        for ring in range(len(profile) - 1):
            for i in range(n):
                a, b = ring * n + i, ring * n + (i + 1) % n
                triangles += [(a, b, b + n), (a, b + n, a + n)]
        for i in range(n):
            triangles += [(last, (i + 1) % n, i), (last + 1, last - n + i, last - n + (i + 1) % n)]
        self.add(label, material, frame, vertices, np.array(triangles))

    def pillow(
        self, label: str, material: int, frame: Frame, size: tuple[float, float, float], n: int = 10
    ) -> None:
        """A cushion: a rounded square that swells in the middle, standing on its local z = 0."""
        grid = np.linspace(-1, 1, n)
        u, v = np.meshgrid(grid, grid, indexing="ij")
        swell = ((1 - u**2) * (1 - v**2)) ** 0.35
        front = np.stack([u * size[0] / 2, swell * size[1] / 2, (v + 1) * size[2] / 2], -1).reshape(
            -1, 3
        )
        back = front * (1, -1, 1)
        i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
        a = (i * n + j).ravel()
        faces = np.concatenate(
            [np.stack([a, a + 1, a + n], 1), np.stack([a + 1, a + n + 1, a + n], 1)]
        )
        self.add(
            label,
            material,
            frame,
            np.concatenate([front, back]),
            np.concatenate([faces, faces[:, ::-1] + n * n]),
        )

    def leaf(
        self,
        label: str,
        material: int,
        frame: Frame,
        length: float,
        reach: float,
        width: float,
        bend: float,
    ) -> None:
        """A bent, pointed blade that grows from the local origin up, and by `reach` (m) along y."""
        t = np.linspace(0, 1, 6)
        spine = np.stack(
            [np.zeros(6), reach * t * (1.5 - 0.5 * t), length * t * (1 - 0.6 * bend * t)], 1
        )
        half = np.stack(
            [0.5 * width * np.sin(np.pi * np.clip(t, 0.04, 1)), np.zeros(6), np.zeros(6)], 1
        )
        vertices = np.concatenate([spine - half, spine + half])
        a = np.arange(5)
        triangles = np.concatenate(
            [np.stack([a, a + 1, a + 6], 1), np.stack([a + 1, a + 7, a + 6], 1)]
        )
        self.add(label, material, frame, vertices, triangles)

    def soup(self) -> Soup:
        counts = [tag[2] for tag in self.tags]
        return Soup(
            np.concatenate(self.vertices).astype(np.float32),
            np.concatenate(self.triangles).astype(np.uint32),
            np.repeat([tag[0] for tag in self.tags], counts).astype(np.int16),
            np.repeat([tag[1] for tag in self.tags], counts).astype(np.int16),
            np.repeat(np.arange(len(self.tags)), counts).astype(np.int32),
            np.stack([origin for origin, _ in self.frames]),
            np.stack([rotation for _, rotation in self.frames]),
        )
