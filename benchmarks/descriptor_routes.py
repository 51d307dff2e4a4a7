"""Routes to the descriptor that `benchmarks/descriptor.py` compares, and the regions it compares them on.

Every route takes regions (means, scales, rotmats [M, n, ...], mask) and gives descriptors [M, n, J, P]: those of the
full spectrum, P = D - 1, or of the lowest K eigenpairs, P = D + 1. The routes other than ours share one batched torch
operator, so that their cost is that of their eigenproblem.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import mpmath
import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import torch
from torch import Tensor

from chebsplat.albo import canonicalize, metric_factors, rotations_about, tangent_axis
from chebsplat.descriptor import describe_compiled, describe_reference
from chebsplat.gaussians import activated, initial_gaussians, local_shape
from chebsplat.rasterize.projection import rotation_matrices
from chebsplat.regions import build_regions
from chebsplat.synthetic import layout

J, D, K = 4, 8, 16
ANISOTROPY, BANDWIDTH = 30.0, 0.7
Regions = tuple[Tensor, Tensor, Tensor, Tensor]


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
    """The pairs of angles of METHOD section 2.3, as `describe_reference` forms them."""
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
        options = {"n_angles": J, "max_degree": D, "anisotropy": ANISOTROPY, "bandwidth": BANDWIDTH}
        return describe_reference(*given, **options, spectrum=spectrum, n_eigs=K, dtype=dtype).values  # type: ignore[arg-type]

    return run


def compiled(given: Regions) -> Tensor:
    options = {"n_angles": J, "max_degree": D, "anisotropy": ANISOTROPY, "bandwidth": BANDWIDTH}
    return describe_compiled(*given, **options).values  # type: ignore[arg-type]


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


def regions_of(kind: str, n: int, m: int) -> Regions:
    """m regions of n Gaussians: `random` flat clouds, `room` from a generated office, `degenerate` lattices, pairs,
    lines and coincident points.
    """
    g = torch.Generator().manual_seed(0)
    means = torch.randn(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.2])
    scales = torch.rand(m, n, 3, generator=g, dtype=torch.float64) * torch.tensor([0.3, 0.2, 0.02]) + 0.01
    rotmats = rotation_matrices(torch.randn(m * n, 4, generator=g, dtype=torch.float64)).reshape(m, n, 3, 3)
    mask = torch.ones(m, n, dtype=torch.bool)
    if kind == "room":
        points, raw = room_gaussians(20_000)
        members = torch.as_tensor(build_regions(points, 4 * m, n).members)
        members = members[(members >= 0).all(1)][:m]  # whole ones: the other routes know no mask
        index, (_, quats, scales, _) = members.clamp_min(0), activated(raw)
        rotmats = rotation_matrices(quats[index].reshape(-1, 4)).reshape(*index.shape, 3, 3).double()
        return torch.as_tensor(points)[index], scales[index].double(), rotmats, members >= 0
    if kind == "degenerate":
        place = torch.arange(n, dtype=torch.float64)
        shapes = [
            torch.stack([place % 8, place // 8 % 8, place // 64], -1),  # a lattice
            torch.stack([place // 2 * 50, place % 2, 0 * place], -1),  # pairs far apart
            torch.stack([place, 0 * place, 0 * place], -1),
            torch.zeros(n, 3, dtype=torch.float64),
        ]
        means = torch.stack([shapes[r % len(shapes)] for r in range(m)])
        scales = torch.full_like(scales, 0.3)
    return means, scales, rotmats, mask


def room_gaussians(n: int) -> tuple[np.ndarray, dict[str, Tensor]]:
    """Points [n, 3] on the surfaces of a generated office, 5 mm off, and the initial Gaussians there."""
    soup, rng = layout.build("office", 0).soup, np.random.default_rng(0)
    corners = soup.vertices[soup.triangles].astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    chosen = rng.choice(len(area), n, p=area / area.sum())
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = corners[chosen, 0] + u * sides[chosen, 0] + v * sides[chosen, 1] + 0.005 * rng.standard_normal((n, 3))
    shape, _ = local_shape(points, 16)
    return points, initial_gaussians(points, np.full((n, 3), 128, np.uint8), shape)


def mpmath_full(given: Regions, r: int) -> np.ndarray:
    """Region r's full-spectrum descriptors of the first angle, [n, D - 1], in 50 digits from the float64 input."""
    mpmath.mp.dps = 50
    means, scales, rotmats = (x[r].numpy() for x in given[:3])
    keep = np.flatnonzero(given[3][r].numpy())
    n = len(keep)
    centres = [[mpmath.mpf(float(v)) for v in means[i]] for i in keep]
    mean = [sum(c[k] for c in centres) / n for k in range(3)]
    centres = [[c[k] - mean[k] for k in range(3)] for c in centres]
    radius = mpmath.sqrt(sum(v * v for c in centres for v in c) / n) or mpmath.mpf(1)
    typical = sorted(scales[i].max() for i in keep)[(n - 1) // 2]
    Y = []
    for i in keep:
        roots = [1 / mpmath.sqrt(1 + ANISOTROPY * (mpmath.mpf(float(s)) / float(typical)) ** 2) for s in scales[i]]
        Y.append([[roots[k] * float(rotmats[i][a, k]) for a in range(3)] for k in range(3)])
    W = mpmath.zeros(n)
    for i in range(n):
        for j in range(i):
            delta = [(centres[i][k] - centres[j][k]) / radius for k in range(3)]
            total = sum(sum(row[a] * delta[a] for a in range(3)) ** 2 for side in (i, j) for row in Y[side])
            W[i, j] = W[j, i] = mpmath.exp(-total / (2 * mpmath.mpf(BANDWIDTH) ** 2))
    root = [mpmath.sqrt(sum(W[i, j] for j in range(n))) for i in range(n)]
    x = mpmath.matrix(n)
    for i in range(n):
        for j in range(n):
            x[i, j] = -W[i, j] / (root[i] * root[j])
    terms = [mpmath.eye(n), x]
    for _ in range(D // 2 - 1):
        terms.append(2 * x * terms[-1] - terms[-2])
    out = np.zeros((given[0].shape[1], D - 1))
    for d in range(2, D + 1):
        m, k = d // 2, d - d // 2
        for i in range(n):
            value = 2 * sum(terms[m][i, j] * terms[k][j, i] for j in range(n)) - (x[i, i] if k > m else 1)
            out[keep[i], d - 2] = n * (value - (1, 0, -1, 0)[d % 4])
    return out
