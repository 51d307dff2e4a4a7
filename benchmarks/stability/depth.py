"""Planes, surfaces and walls that break the plain way to depth (docs/method.md, section 5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.photos.planar import completed
from chebsplat.rasterize.depths import depths
from chebsplat.splats.planes import GRAZING, inverse_depths
from chebsplat.training.losses import depth_distance

HEIGHT, WIDTH = 32, 48
K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
LOSS = 1e-5  # a mean of float32
PLANES = 1e-5  # float32
JUMP = 1e-3  # of 1 / z at a corner, for a turn of 1e-6 rad, which moves it by 1e-4 at most


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) + 0.5


Surface = tuple[Tensor, Tensor, Tensor, Tensor | None]  # inverse depth, coverage, truth, mask


def surface(unit: float = 1.0, alpha: float = 0.9) -> Surface:
    """A surface at 0.5 to 1.5 units, measured, and rendered 10 % off."""
    truth, covered = unit * noise(HEIGHT, WIDTH), alpha * torch.ones(HEIGHT, WIDTH, 1)
    return (
        covered[..., 0] / truth * (0.9 + 0.2 * noise(HEIGHT, WIDTH, seed=1)),
        covered,
        truth,
        None,
    )


def measured(change: Callable[[Tensor], object], mask: Tensor | None = None) -> Surface:
    rendered, covered, truth, _ = surface()
    change(truth)
    return rendered, covered, truth, mask


LOSSES: dict[str, Callable[[], Surface]] = {
    "units of 1e-20": lambda: surface(1e-20),
    "units of 1e-03": lambda: surface(1e-3),
    "units of 1e+20": lambda: surface(1e20),
    "nothing covered": lambda: surface(alpha=0.0),
    "coverage of 1e-30": lambda: surface(alpha=1e-30),
    "nothing measured": lambda: measured(lambda d: d.fill_(torch.nan)),
    "depth of 0": lambda: measured(lambda d: d.zero_()),
    "half NaN": lambda: measured(lambda d: d[::2].fill_(torch.nan)),
    "half infinite": lambda: measured(lambda d: d[::2].fill_(torch.inf)),
    "half negative": lambda: measured(lambda d: d[::2].fill_(-1)),
    "one pixel measured": lambda: measured(lambda d: d.view(-1)[1:].fill_(0)),
    "nothing counts": lambda: measured(lambda d: d, torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)),
}


@case("loss, {name}", name=LOSSES)
def loss(name: str) -> Outcome:
    """The loss and its gradient against float64; the plain way masks by multiplication."""
    rendered, covered, truth, mask = LOSSES[name]()
    has_depth = (
        np.isfinite(truth.numpy()) & (truth.numpy() > 0) & (True if mask is None else mask.numpy())
    )
    d, a = (part.double().numpy() for part in (truth, covered[..., 0]))
    missed = rendered.double().numpy()[has_depth] * d[has_depth] - a[has_depth]
    exact = np.zeros(truth.shape)
    exact[has_depth] = np.sign(missed) * d[has_depth] / max(has_depth.sum(), 1)
    exact_loss = np.abs(missed).sum() / max(has_depth.sum(), 1)

    def by(function: Callable[[Tensor], Tensor]) -> tuple[np.ndarray, np.ndarray]:
        leaf = rendered.clone().requires_grad_(True)
        value = function(leaf)
        return value.detach().numpy(), torch.autograd.grad(value, leaf)[0].numpy()

    def plainly(leaf: Tensor) -> Tensor:
        counts = (truth > 0) * torch.ones_like(truth) * (1 if mask is None else mask)
        return (counts * (leaf * truth - covered[..., 0]).abs()).sum() / counts.sum()

    def apart(ours: tuple[np.ndarray, ...], exact: tuple[np.ndarray, ...]) -> float:
        return max(relative(*pair) for pair in zip(ours, exact, strict=True))

    ours = by(lambda leaf: depth_distance(leaf, covered, truth, mask))
    return beside(ours, lambda: by(plainly), (exact_loss, exact), LOSS, apart)


def planes_of(cosines: np.ndarray, unit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Centres [N, 3] of planes whose normals [N, 3] have these cosines to the line of sight."""
    mean = np.array([0.3, -0.2, 2.0])
    toward = mean / np.linalg.norm(mean)
    across = np.cross(toward, [0, 1.0, 0])
    across /= np.linalg.norm(across)
    normals = cosines[:, None] * toward + np.sqrt(1 - cosines**2)[:, None] * across
    return unit * np.tile(mean, (len(cosines), 1)), normals


def corner(
    means: np.ndarray, normals: np.ndarray, nearest: float = 0.01, dtype: type = np.float64
) -> np.ndarray:
    """1 / z [N] of planes at a corner of the image."""
    tensors = (torch.from_numpy(part.astype(dtype)) for part in (means, normals, K))
    return np.asarray(inverse_depths(*tensors, nearest).numpy() @ np.array([WIDTH, HEIGHT, 1.0]))


@case("planes about a cosine of {cosine:g}", cosine=[GRAZING, -GRAZING, 0.0, 1e-3, 1.0 - 1e-6])
def jumps(cosine: float) -> Outcome:
    """Change of 1 / z at a corner by a turn of 1e-6; plainly, grazed planes turn facing ones."""
    means, normals = planes_of(np.array([cosine - 1e-6, cosine + 1e-6]))

    def plainly() -> np.ndarray:
        along = (normals * means).sum(1)
        grazed = np.abs(along) < GRAZING * np.linalg.norm(means, axis=1)
        values = normals @ np.linalg.inv(K) @ (WIDTH, HEIGHT, 1) / along
        return np.where(grazed, 1 / means[:, 2], values)

    moved, plain = (
        float(np.abs(np.diff(values))[0]) for values in (corner(means, normals), plainly())
    )
    return Outcome(moved, JUMP, plain)


@case("planes in units of {unit:.0e}", unit=[1e-6, 1e-3, 1e3, 1e6, 1e15])
def units(unit: float) -> Outcome:
    """1 / z in float32, times the unit, against float64 with a unit of 1, at all angles."""
    cosines = np.linspace(-1, 1, 41)
    exact = corner(*planes_of(cosines))
    ours = unit * corner(*planes_of(cosines, unit), 0.01 * unit, np.float32).astype(np.float64)
    return Outcome(relative(ours, exact), PLANES)


def wall(tilt: float, unit: float) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Gaussians that tile a wall through (0, 0, 2), their planes, and the wall's depth [H, W]."""
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    right, down = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([0, 1.0, 0])
    steps = np.stack(
        np.meshgrid(np.linspace(-4, 4, 60), np.linspace(-3, 3, 46), indexing="ij"), -1
    ).reshape(-1, 2)
    means = np.array([0, 0, 2.0]) + steps @ np.stack([right, down])
    means = means[means[:, 2] > 0.2]
    n, half = len(means), -tilt / 2
    quats = np.tile([np.cos(half), 0, np.sin(half), 0], (n, 1))
    scales, opacities = np.tile([0.1, 0.1, 1e-4], (n, 1)), np.full(n, 0.8)
    planes = inverse_depths(
        *(torch.from_numpy(v) for v in (unit * means, np.tile(normal, (n, 1)), K)), 0.01 * unit
    )
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    gaussians = tuple(
        part.astype(np.float32) for part in (unit * means, quats, unit * scales, opacities)
    )
    return gaussians, planes.numpy(), 2 * unit * normal[2] / (rays @ normal)


@case(
    "the depth of a wall turned by {degrees} degrees, units of {unit:.0e}",
    degrees=[0, 40],
    unit=[0.1, 1e3],
)
def walls(degrees: float, unit: float) -> Outcome:
    """Relative to the wall's depth; the plain way takes that of the nearest Gaussian's centre."""
    gaussians, planes, exact = wall(np.radians(degrees), unit)
    depth, _ = depths(gaussians, np.eye(4), K, (WIDTH, HEIGHT), planes)

    def plainly() -> np.ndarray:
        facing = planes * 0
        facing[:, 2] = 1 / gaussians[0][:, 2]
        return depths(gaussians, np.eye(4), K, (WIDTH, HEIGHT), facing)[0] / exact

    return beside(depth / exact, plainly, np.ones_like(exact), 1e-3)


def patch(unit: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth of a slanted wall of one colour, a fifth of it measured, else 0; colours; all depth."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    exact = unit / (0.3 + 0.004 * row + 0.006 * column)
    has_depth = np.random.default_rng(0).random(exact.shape) < 0.2
    return np.where(has_depth, exact, 0), np.full((*exact.shape, 3), 0.4), exact


@case("a plain wall in units of {unit:.0e}", unit=[1e-6, 1e-3, 1e3, 1e6])
def plain_walls(unit: float) -> Outcome:
    """Completed depth over the wall's; the plain way takes the mean of the measured depth."""
    depth, colors, exact = patch(unit)
    ones = np.ones_like(exact)
    return beside(
        completed(depth, colors) / exact, lambda: depth[depth > 0].mean() / exact, ones, PLANES
    )


UNKNOWN: dict[str, Callable[[np.ndarray], object]] = {
    "nothing known": lambda d: d.fill(0),
    "all known": lambda d: d.__setitem__(..., patch()[2]),
    "known along a line": lambda d: (
        d.__setitem__(slice(1, None), 0),
        d.__setitem__(0, patch()[2][0]),
    ),
    "known at one pixel": lambda d: (d.fill(0), d.__setitem__((3, 3), 2.0)),
}


@case("a plain wall, {name}", name=UNKNOWN)
def unknown(name: str) -> Outcome:
    """Depth that defines no plane adds nothing."""
    depth, colors, _ = patch()
    UNKNOWN[name](depth)
    return Outcome(relative(completed(depth, colors), depth), 1e-6)
