"""Routes to the descriptor that `python -m benchmarks descriptor` compares.

Every route takes regions (means, scales, rotmats [M, n, ...], mask) and gives descriptors [M, n, J, P]: those of the
full spectrum, P = D - 1, or of the lowest K eigenpairs, P = D + 1. The routes other than ours share one batched torch
operator, so that their cost is that of their eigenproblem.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import torch
from torch import Tensor

from benchmarks.descriptor.cases import ANISOTROPY, BANDWIDTH, D, J, K, Regions
from chebsplat.shape.albo import canonicalize, metric_factors, rotations_about, tangent_axis
from chebsplat.shape.descriptor import describe


@dataclass
class Route:
    """`most` bounds how many regions are worth its time; `full` says which oracle it is held against."""

    name: str
    full: bool
    most: int
    run: Callable[[Regions], Tensor]


def operators(given: Regions, dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """S and A^½ of each angle, and the certainty: batched, differences formed directly, plain exponentials."""
    region = canonicalize(*given)
    factors = metric_factors(region, ANISOTROPY).to(dtype)
    axis, certainty = tangent_axis(region)
    pair = region.mask[:, :, None] & region.mask[:, None] & ~torch.eye(given[0].shape[1], dtype=torch.bool)
    found, roots = [], []
    for rotation in rotations_about(axis, J):
        turned = (region.means @ rotation).to(dtype)
        delta = turned[:, None] - turned[:, :, None]
        lengths = (delta @ factors.transpose(-1, -2)).square().sum(-1)
        weights = torch.exp((lengths + lengths.transpose(1, 2)) * (-0.5 / BANDWIDTH**2)) * pair
        root = weights.sum(-1).sqrt()
        found.append(weights / root[:, :, None] / root[:, None])
        roots.append(root)
    return found, roots, certainty.to(dtype)


def paired(angles: list[Tensor], certainty: Tensor) -> Tensor:
    """The pairs of angles of docs/method.md, section 2, as `descriptor_reference.describe` forms them."""
    fade = certainty[:, None, None]
    rest = []
    for j in range(1, J):
        low, high = angles[min(j, J - j)], angles[max(j, J - j)]
        mean = angles[0] + fade * (0.5 * (low + high) - angles[0])
        rest.append(mean if j <= J - j else fade * 0.5 * (low - high).abs())
    return torch.stack([angles[0], *rest], 2)


def from_eigenpairs(values: Tensor, squares: Tensor, full: bool) -> Tensor:
    """n Σ_k T_d(x_k) ψ_k², with x = λ − 1 over the full spectrum, or 2 λ / λ_K − 1 over its lowest part."""
    n = squares.shape[-2]
    x = values - 1 if full else 2 * (values / values[..., -1:].clamp_min(1e-3)).clamp(0, 1) - 1
    terms = [torch.ones_like(x), x]
    for _ in range(D - 1):
        terms.append(2 * x * terms[-1] - terms[-2])
    polynomials = torch.stack(terms, -1)
    if full:
        polynomials = polynomials[..., 2:] - polynomials.new_tensor([(1, 0, -1, 0)[d % 4] for d in range(2, D + 1)])
    return n * (squares @ polynomials)


def dense(dtype: torch.dtype, full: bool) -> Callable[[Regions], Tensor]:
    def run(given: Regions) -> Tensor:
        found, _, certainty = operators(given, dtype)
        angles = []
        for S in found:
            values, vectors = torch.linalg.eigh(torch.eye(S.shape[1], dtype=dtype) - S)
            kept = slice(None) if full else slice(K)
            angles.append(from_eigenpairs(values[:, kept], vectors[..., kept] ** 2, full))
        return paired(angles, certainty)

    return run


def one_by_one(solve: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Callable[[Regions], Tensor]:
    """A route over single matrices: `solve` takes S and gives the K smallest eigenvalues of I − S and ψ²."""

    def run(given: Regions) -> Tensor:
        found, _, certainty = operators(given, torch.float64)
        angles = []
        for S in found:
            parts = [solve(s.numpy()) for s in S]
            values, squares = (torch.from_numpy(np.stack(x)) for x in zip(*parts, strict=True))
            angles.append(from_eigenpairs(values, squares, False))
        return paired(angles, certainty)

    return run


def subset(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = scipy.linalg.eigh(np.eye(len(S)) - S, subset_by_index=(0, K - 1))
    return values, vectors**2


def lanczos(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = scipy.sparse.linalg.eigsh(S, K, which="LA", v0=np.linspace(1, 2, len(S)))
    order = np.argsort(-values)
    return 1 - values[order], vectors[:, order] ** 2


def lobpcg(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    start = np.random.default_rng(0).standard_normal((len(S), K))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns where it falls back on a dense solver, and where it stalls
        values, vectors = scipy.sparse.linalg.lobpcg(S, start, largest=True, tol=1e-7, maxiter=60)
    order = np.argsort(-values)
    return 1 - values[order], vectors[:, order] ** 2


def printed(dtype: torch.dtype) -> Callable[[Regions], Tensor]:
    """As printed: eigenpairs of the non-symmetric I − A⁻¹ W, the K smallest real parts. Vectors are scaled to unit
    A-norm, or the result would not be comparable.
    """

    def run(given: Regions) -> Tensor:
        found, roots, certainty = operators(given, dtype)
        angles = []
        for S, root in zip(found, roots, strict=True):
            walk = (S * root[:, None] / root[:, :, None]).numpy()
            values, vectors = np.linalg.eig(np.eye(len(walk[0]), dtype=walk.dtype) - walk)
            order = np.argsort(values.real, axis=1)[:, :K]
            chosen = np.take_along_axis(vectors.real, order[:, None], 2)
            kept = torch.from_numpy(np.take_along_axis(values.real, order, 1).copy())
            squares = torch.from_numpy(chosen**2) * root[:, :, None] ** 2
            angles.append(from_eigenpairs(kept, squares / squares.sum(1, keepdim=True), False))
        return paired(angles, certainty)

    return run


def reference(dtype: torch.dtype, spectrum: str = "full") -> Callable[[Regions], Tensor]:
    def run(given: Regions) -> Tensor:
        options: dict[str, Any] = {"n_angles": J, "max_degree": D, "anisotropy": ANISOTROPY, "bandwidth": BANDWIDTH}
        options |= {"spectrum": spectrum, "n_eigs": K, "dtype": dtype, "backend": "reference"}
        return describe(*given, **options).values

    return run


def compiled(given: Regions) -> Tensor:
    sizes = {"n_angles": J, "max_degree": D}
    return describe(*given, **sizes, anisotropy=ANISOTROPY, bandwidth=BANDWIDTH, backend="numba").values


ROUTES = [
    Route("printed: numpy eig float64", False, 12, printed(torch.float64)),
    Route("printed: numpy eig float32", False, 12, printed(torch.float32)),
    Route("torch eigh float64, K", False, 48, dense(torch.float64, False)),
    Route("torch eigh float32, K", False, 48, dense(torch.float32, False)),
    Route("scipy eigh subset float64, K", False, 8, one_by_one(subset)),
    Route("scipy Lanczos float64, K", False, 4, one_by_one(lanczos)),
    Route("scipy LOBPCG float64, K", False, 2, one_by_one(lobpcg)),
    Route("hard: ours, float64, K", False, 24, reference(torch.float64, "hard")),
    Route("torch eigh float64, full", True, 48, dense(torch.float64, True)),
    Route("torch eigh float32, full", True, 48, dense(torch.float32, True)),
    Route("polynomial: torch float64, full", True, 24, reference(torch.float64)),
    Route("polynomial: torch float32, full", True, 24, reference(torch.float32)),
    Route("polynomial: ours, compiled float32", True, 512, compiled),
]
