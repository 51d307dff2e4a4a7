"""What the printed modules are tried on: random inputs, degenerate ones, and how near is near."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from .oracles import Array, State

Region = tuple[Array, Array]  # centers, covariances

# What becomes of a matrix of normal numbers.
MATRICES: dict[str, Callable[[Array], Array]] = {
    "zeros": lambda x: 0 * x,
    "ones": lambda x: 0 * x + 1,
    "minus ones": lambda x: 0 * x - 1,
    "tiny": lambda x: 1e-8 * x,
    "huge": lambda x: 1e6 * x,
    "high": lambda x: 0 * x + 1e3,
    "low": lambda x: 0 * x - 1e3,
    "high and low": lambda x: 1e3 * np.sign(x),
    "one row": lambda x: x[:1],
    "no rows": lambda x: x[:0],
    "two rows": lambda x: x[:2],
    "one column": lambda x: x * (np.arange(x.shape[1]) == 0),
    "one row set": lambda x: x * (np.arange(len(x)) == 0)[:, None],
    "one entry": lambda x: x * (np.arange(x.size) == 3).reshape(x.shape),
    "equal rows": lambda x: 0 * x + x[:1],
    "equal columns": lambda x: 0 * x + x[:, :1],
    "rows of all sizes": lambda x: x * np.logspace(-8, 6, len(x))[:, None],
    "columns of all sizes": lambda x: x * np.logspace(-8, 6, x.shape[1]),
    "positive": np.abs,
    "whole numbers": np.round,
}

ONE = np.eye(3)
FIRST = (np.arange(6) == 0)[:, None]
# What becomes of a region of six members.
REGIONS: dict[str, Callable[[Array, Array], Region]] = {
    "no members": lambda c, s: (c[:0], s[:0]),
    "single member": lambda c, s: (c[:1], s[:1]),
    "two members": lambda c, s: (c[:2], s[:2]),
    "coincident": lambda c, s: (0 * c, s),
    "coincident far from the origin": lambda c, s: (0 * c + 1e6, s),
    "two coincide": lambda c, s: (c[[0, 0, 1, 2, 3, 4]], s),
    "tiny": lambda c, s: (1e-8 * c, 1e-16 * s),
    "huge": lambda c, s: (1e6 * c, 1e12 * s),
    "all isolated": lambda c, s: (1e6 * c, s),
    "one isolated": lambda c, s: (c + 1e6 * FIRST, s),
    "one weakly attached": lambda c, s: (c + 3 * FIRST, 0 * s),
    "two clusters": lambda c, s: (c + 1e3 * (np.arange(6) < 3)[:, None], s),
    "in a line": lambda c, s: (c * [1, 0, 0], s),
    "in a plane": lambda c, s: (c * [1, 1, 0], s),
    "equally far": lambda c, s: (np.vstack([ONE, -ONE]), 0 * s + ONE),
    "equal covariances": lambda c, s: (c, 0 * s + s[:1]),
    "flat covariances": lambda c, s: (c, s * [[1, 1, 0], [1, 1, 0], [0, 0, 0]]),
    "no covariances": lambda c, s: (c, 0 * s),
    "huge covariances": lambda c, s: (c, 1e6 * s),
    "tiny covariances": lambda c, s: (c, 1e-8 * s),
}
ALBO = {"beta": 2.0, "sigma": 1.5}
ANGLES = [0.0, 0.75, 2.125]
# What becomes of points, centers and covariances, and the temperature.
PLACES: dict[str, Callable[[Array, Array, Array], tuple[Array, Array, Array, float]]] = {
    "no points": lambda q, c, s: (q[:0], c, s, 1),
    "no regions": lambda q, c, s: (q, c[:0], s[:0], 1),
    "one region": lambda q, c, s: (q, c[:1], s[:1], 1),
    "one point": lambda q, c, s: (q[:1], c, s, 1),
    "points at centers": lambda q, c, s: (c, c, s, 1),
    "coincident centers": lambda q, c, s: (q, 0 * c, s, 1),
    "equal regions": lambda q, c, s: (q, 0 * c, 0 * s + ONE, 1),
    "all in one place": lambda q, c, s: (0 * q, 0 * c, s, 1),
    "tiny": lambda q, c, s: (1e-8 * q, 1e-8 * c, 1e-16 * s, 1),
    "huge": lambda q, c, s: (1e6 * q, 1e6 * c, 1e12 * s, 1),
    "far points": lambda q, c, s: (q * 1e3, c, s, 1),
    "far points, one region": lambda q, c, s: (q + 1e6, c[:1], s[:1], 1),
    "tiny covariances": lambda q, c, s: (q, c, 1e-8 * s, 1),
    "huge covariances": lambda q, c, s: (q, c, 1e6 * s, 1),
    "flat covariances": lambda q, c, s: (q, c, s * [[1, 1, 0], [1, 1, 0], [0, 0, 0]], 1),
    "needles": lambda q, c, s: (q, c, s * [[1, 0, 0], [0, 0, 0], [0, 0, 0]], 1),
    "no covariances": lambda q, c, s: (q, c, 0 * s, 1),
    "hot": lambda q, c, s: (q, c, s, 1e6),
    "cold": lambda q, c, s: (q, c, s, 1e-6),
    "in a plane": lambda q, c, s: (q * [1, 1, 0], c * [1, 1, 0], s, 1),
}

both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["32", "64"])
matrices = pytest.mark.parametrize("kind", ["random", *MATRICES])
regions = pytest.mark.parametrize("kind", ["random", *REGIONS])


def single(values: object) -> Array:
    """Numbers that float32 holds, as float64."""
    return np.asarray(values, np.float64).astype(np.float32).astype(np.float64)


def tensor(values: object, dtype: torch.dtype = torch.float64) -> Tensor:
    """Floats in the given precision; bools and integers as they are."""
    array = np.asarray(values)
    return torch.tensor(array, dtype=dtype if array.dtype.kind == "f" else None)


def samples(kind: str, n: int, c: int) -> Iterator[tuple[np.random.Generator, Array]]:
    """50 random matrices, or the degenerate one."""
    for seed in range(50 if kind == "random" else 1):
        rng = np.random.default_rng(seed + 1)
        x = rng.normal(size=(n, c))
        yield rng, single(x if kind == "random" else MATRICES[kind](x))


def turned_ellipsoids(rng: np.random.Generator, n: int) -> Array:
    """Covariances of random orientation, their eigenvalues 0.6 to 2."""
    turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return turns * rng.uniform(0.6, 2, (n, 1, 3)) @ turns.transpose(0, 2, 1)


def make_regions(kind: str) -> list[Region]:
    """50 random regions of 3 to 8 members, or the degenerate one."""
    result = []
    for seed in range(50 if kind == "random" else 1):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(3, 9)) if kind == "random" else 6
        region = (rng.normal(size=(n, 3)), turned_ellipsoids(rng, n))
        centers, covariances = region if kind == "random" else REGIONS[kind](*region)
        result.append((single(centers), single(covariances)))
    return result


def padded(items: list[Array], n: int, axes: int, padding: float) -> tuple[Array, Array]:
    """Members at places chosen at random among n, in each of `axes` dimensions; which they are."""
    rng, noise = np.random.default_rng(9), np.random.default_rng(8)
    present = np.zeros((len(items), n), bool)
    result = padding * noise.normal(size=(len(items), *[n] * axes, *items[0].shape[axes:]))
    for r, item in enumerate(items):
        places = np.sort(rng.permutation(n)[: len(item)])
        present[r, places] = True
        result[r][np.ix_(*[places] * axes)] = item
    return single(result), present


def agree(actual: Tensor, expected: object, size: float | None = None) -> None:
    """To 1e-10 in float64 and 1e-6 in float32 of the size of the values."""
    wanted = np.asarray(expected, np.float64)
    size = float(np.abs(wanted).max(initial=0)) if size is None else size
    near = {torch.float32: 1e-6, torch.float64: 1e-10}[actual.dtype] * size
    assert tuple(actual.shape) == wanted.shape
    np.testing.assert_allclose(actual.detach().double().numpy(), wanted, rtol=0, atol=near)


def randomise(module: nn.Module, rng: np.random.Generator, dtype: torch.dtype) -> State:
    """Gives a module random weights; returns them."""
    module.to(dtype)
    for parameter in module.parameters():
        parameter.data = tensor(single(0.4 * rng.normal(size=tuple(parameter.shape))), dtype)
    return {name: value.double().numpy() for name, value in module.state_dict().items()}


def room(values: Array, n_eigs: int, dtype: torch.dtype) -> float:
    """What the least gap down to the first eigenvalue left out allows; 0 where it is too small."""
    gap = np.diff(np.sort(values)[: n_eigs + 1]).min(initial=1)
    if dtype == torch.float32:
        return float(4 / gap) if gap > 0.02 else 0
    return 1 if gap > 1e-3 else 0


def all_pairs(n_points: int, n_regions: int) -> tuple[Tensor, Tensor]:
    """Every point in every region."""
    points = torch.arange(n_points).repeat_interleave(n_regions)
    return points, torch.arange(n_regions).repeat(n_points)


def some_pairs(rng: np.random.Generator, n_points: int, n_regions: int) -> tuple[Tensor, Tensor]:
    """Pairs in a random order; no point in the last region, the first point in no region."""
    held = rng.random((n_points, n_regions)) < 0.8
    held[:, -1:] = held[:1] = False
    points, of = rng.permutation(np.argwhere(held)).T
    return tensor(points), tensor(of)


def basis_for(rng: np.random.Generator, q: int, rank: int) -> Array:
    """Orthonormal columns in R^q, as many as asked for and possible."""
    return single(np.linalg.qr(rng.normal(size=(q, q)))[0][:, :rank])
