"""Descriptors of a part of the spectrum (Eqs 4-6 with K < n), in float64: tapered at K, or cut hard behind it.

g^d(i) = n Σ_k w_k T_d(x_k) ψ_k(i)², d = 0...D, with eigenpairs (λ_k, ψ_k) of L = I − S in rising order. ψ² = a φ² for
eigenvectors φ = A^-1/2 ψ of Eq 3 of unit A-norm, so it does not depend on the basis of an eigenspace that is whole.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

SMALLEST = 1e-3  # of λ_c and λ_max: a region of many components has K zero eigenvalues
SAME = 1e-9  # eigenvalues this close are one eigenspace: round-off is 1e-15
CLUSTER = 1e-4  # a gap below this leaves few digits of single eigenvectors in float32


class Cut(NamedTuple):
    """values f64 [M, n, D + 1]; n_cuts regions were cut below n; n_clustered of the cuts asked for fell into a
    cluster, so that they were moved behind it or lie at a gap below `CLUSTER`; n_guarded have a λ_max below `SMALLEST`.
    """

    values: Tensor
    n_cuts: int
    n_clustered: int
    n_guarded: int


def cut_spectrum(S: Tensor, mask: Tensor, n_eigs: int, max_degree: int, *, hard: bool) -> Cut:
    """The lowest part of each region's spectrum.

    Args: S f64 [M, n, n] from `albo.similarity`; mask [M, n]; n_eigs: K, at least 1.
    Returns: values, zero where padded.
    Choices: `hard` keeps the K smallest and all of the last one's eigenspace, w = 1, x = 2 λ / λ_max − 1 with λ_max
      the largest kept one. Otherwise w = 1 − smoothstep(2 λ / λ_c − 1) and x = 2 min(λ / λ_c, 1) − 1 with
      λ_c = λ_(K+1), the last of all if K >= n: no cluster is ever split. Neither λ_max nor λ_c goes below
      `SMALLEST`. Eigenpairs on one thread: libraries slow down severalfold when they share such small matrices out.
    """
    m, n = mask.shape
    count = mask.sum(1).numpy()
    laplacian = torch.eye(n, dtype=torch.float64) - S.detach()
    # Padding goes behind the spectrum, which ends at 2.
    laplacian = laplacian + torch.diag_embed(torch.where(mask, 0.0, 3.0).double())
    values, vectors = _eigenpairs(laplacian)
    values = np.clip(values, 0.0, None)
    index, rows = np.arange(n), np.arange(m)
    wanted = np.minimum(n_eigs, count)
    valid = index < count[:, None]
    n_cuts = n_clustered = n_guarded = 0
    if hard:
        gaps = np.diff(values, axis=1, append=np.inf)  # behind each eigenvalue
        gaps = np.where(index < count[:, None] - 1, gaps, np.inf)
        chained = np.where(index < wanted[:, None] - 1, True, gaps <= SAME)
        kept = 1 + np.argmin(np.concatenate([chained[:, :-1], np.zeros((m, 1), bool)], 1), axis=1)
        kept = np.minimum(kept, count)
        cuts = wanted < count
        n_cuts = int(cuts.sum())
        n_clustered = int((cuts & (gaps[rows, np.maximum(wanted, 1) - 1] <= CLUSTER)).sum())
        weights = (index < kept[:, None]).astype(np.float64)
        largest = values[rows, np.maximum(kept, 1) - 1]
        n_guarded = int(((largest < SMALLEST) & (count > 1)).sum())
        largest = np.maximum(largest, SMALLEST)[:, None]
        x = 2 * np.minimum(values / largest, 1.0) - 1
    else:
        behind = np.minimum(wanted, np.maximum(count, 1) - 1)
        largest = np.maximum(values[rows, behind], SMALLEST)[:, None]
        t = np.clip(2 * values / largest - 1, 0.0, 1.0)
        weights = np.where(valid, 1 - t * t * (3 - 2 * t), 0.0)
        x = 2 * np.minimum(values / largest, 1.0) - 1
    polynomials = np.cos(np.arange(max_degree + 1) * np.arccos(np.clip(x, -1.0, 1.0))[..., None])
    out = count[:, None, None] * ((vectors**2) @ (weights[..., None] * polynomials))
    return Cut(torch.from_numpy(np.where(mask.numpy()[..., None], out, 0.0)), n_cuts, n_clustered, n_guarded)


def _eigenpairs(matrices: Tensor) -> tuple[np.ndarray, np.ndarray]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        values, vectors = torch.linalg.eigh(matrices)
    finally:
        torch.set_num_threads(threads)
    return values.numpy(), vectors.numpy()
