"""Depth that breaks plain triangles, and meshes hard to measure (docs/usage.md, `chebsplat mesh`).

Errors of a mesh are its vertices' distances from the true surface, in voxels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.stability.case import Outcome, beside, case
from chebsplat.formats.meshes import Frame, Mesh, fuse_depth
from chebsplat.stages.tools.mesh import away, drop_edges
from chebsplat.synthetic.rays import open3d

HEIGHT, WIDTH, VOXEL, WALL = 30, 40, 0.05, 2.0
K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
NEAR = 0.02  # voxels: a plane is where a distance is 0 between two of them


def frames(unit: float = 1.0, shift: float = 0.0, n: int = 6) -> list[Frame]:
    """A red wall at z = 2 from places side by side, `shift` so far from the origin."""
    views = []
    for view in range(n):
        pose = np.eye(4)
        pose[:3, 3] = -unit * np.array([0.03 * view, 0, 0]) - shift
        color = np.full((HEIGHT, WIDTH, 3), (200, 40, 90), np.uint8)
        views.append(Frame(np.full((HEIGHT, WIDTH), unit * WALL, np.float32), color, K, pose))
    return views


def spoiled(value: float, views: slice = np.s_[:], rows: slice = np.s_[:10]) -> list[Frame]:
    of = frames()
    for frame in of[views]:
        frame.depth[rows] = value
    return of


def one_pixel(place: tuple[int, int]) -> list[Frame]:
    of = spoiled(0, rows=np.s_[:])
    for frame in of:
        frame.depth[place] = WALL
    return of


WALLS: dict[str, Callable[[], tuple[list[Frame], float, float]]] = {
    "in units of 1e-03": lambda: (frames(1e-3), 1e-3, 0.0),
    "in units of 1e+03": lambda: (frames(1e3), 1e3, 0.0),
    "1e+03 from the origin": lambda: (frames(shift=1e3), 1.0, 1e3),
    "a third unknown": lambda: (spoiled(0), 1.0, 0.0),
    "a third infinite": lambda: (spoiled(np.inf), 1.0, 0.0),
    "a third negative": lambda: (spoiled(-1), 1.0, 0.0),
    "a third at 1e+30": lambda: (spoiled(1e30), 1.0, 0.0),
    "two views that know nothing": lambda: (spoiled(0, np.s_[:2], np.s_[:]), 1.0, 0.0),
    "a view of one pixel": lambda: (spoiled(0, np.s_[:1], np.s_[1:]), 1.0, 0.0),
}


@case("a wall {name}", name=WALLS)
def walls(name: str) -> Outcome:
    """Raises ValueError without a mesh. The plain way takes each pixel for a vertex, in float32."""
    of, unit, shift = WALLS[name]()
    mesh = fuse_depth(open3d(), of, unit * VOXEL, 10 * unit)
    if len(mesh.triangles) < 500 or (mesh.colors != mesh.colors[0]).any():
        raise ValueError(f"{len(mesh.triangles)} triangles, or of another colour")

    def plainly() -> np.ndarray:
        depth = np.concatenate([frame.depth.ravel() for frame in of])
        return (depth - np.float32(of[0].pose[2, 3])).astype(np.float32)

    def off(ours: np.ndarray, exact: float) -> float:
        return (
            float(np.abs(ours - exact).max() / (unit * VOXEL))
            if np.isfinite(ours).all()
            else float("inf")
        )

    return beside(mesh.vertices[:, 2], plainly, unit * WALL + shift, NEAR, off)


EMPTY: dict[str, Callable[[], list[Frame]]] = {
    "no frame": list,
    "three views, more than which a voxel needs": lambda: frames(n=3),
    "nothing known": lambda: spoiled(0, rows=np.s_[:]),
    "all farther than is looked at": lambda: spoiled(1e3, rows=np.s_[:]),
    "one pixel known, between those that open3d looks at": lambda: one_pixel((3, 7)),
}


@case("empty, {name}", name=EMPTY)
def empty(name: str) -> Outcome:
    """Number of vertices and triangles."""
    mesh = fuse_depth(open3d(), EMPTY[name](), VOXEL, 10.0)
    return Outcome(float(len(mesh.vertices) + len(mesh.triangles)), 0.0)


@case(
    "edges of depth in units of {unit:.0e}, {hole} beside",
    unit=[1e-30, 1.0, 1e30],
    hole=[0.0, np.nan],
)
def edges(unit: float, hole: float) -> Outcome:
    """Pixels left of two walls, a step between them, a hole in one; plainly, steps are in units."""
    depth = np.full((12, 16), 2.0)
    depth[:, 8:], depth[4:6, 2:4] = 3.0, hole
    exact = np.where(depth > 0, depth, 0)
    exact[:, 7:9] = 0
    measured = (unit * depth).astype(np.float32)

    def plainly() -> np.ndarray:
        far = np.abs(np.diff(measured, axis=1, append=measured[:, -1:])) > 0.1
        return np.where(far | np.roll(far, 1, 1), 0, measured) / np.float32(unit)

    return beside(drop_edges(measured) / np.float32(unit), plainly, exact, 1e-6)


def ball(n: int = 40) -> Mesh:
    """A unit ball of long triangles."""
    v, u = np.meshgrid(
        np.linspace(0, np.pi, n // 2), np.linspace(0, 2 * np.pi, n, endpoint=False), indexing="ij"
    )
    vertices = (
        np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1)
        .reshape(-1, 3)
        .astype(np.float32)
    )
    index = np.arange(len(vertices)).reshape(n // 2, n)
    a, b, c, d = index[:-1], np.roll(index, -1, 1)[:-1], index[1:], np.roll(index, -1, 1)[1:]
    triangles = (
        np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
        .reshape(-1, 3)
        .astype(np.int32)
    )
    return Mesh(vertices, triangles, np.zeros((len(vertices), 3), np.uint8))


@case("how far points are from a ball of {radius:.0e}", radius=[1e-6, 1.0, 1e6])
def distances(radius: float) -> Outcome:
    """Of points at 1.5 radii, over the radius; plainly, to the nearest vertex of a coarse ball."""
    of, points = ball(), np.random.default_rng(0).normal(size=(500, 3))
    points *= 1.5 * radius / np.linalg.norm(points, axis=1, keepdims=True)
    mesh = of._replace(vertices=np.float32(radius) * of.vertices)
    coarse = radius * ball(8).vertices

    def plainly() -> float:
        return float(np.median(cKDTree(coarse).query(points)[0])) / radius

    return beside(away(mesh, points) / radius, plainly, 0.5, 0.02)
