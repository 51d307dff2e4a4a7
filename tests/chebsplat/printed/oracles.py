"""The paper's method section in plain float64 numpy: one function for each equation or definition.

Each function takes what the formula names: one region, one point or one matrix, without padding.
What the print leaves open follows the printed modules' own description.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = dict[str, Array]  # a module's weights by name


def metric(covariance: Array, beta: float) -> Array:
    """Eq 1: M_i = R_i diag(1 / (1 + β λ_ik)) R_iᵀ."""
    values, rotation = np.linalg.eigh(covariance)
    return rotation @ np.diag(1 / (1 + beta * values)) @ rotation.T


def edge_weights(centers: Array, metrics: Array, sigma: float) -> Array:
    """Eq 2, for every two members: w_ij = exp(−(c_i − c_j)ᵀ M̄_ij (c_i − c_j) / σ²)."""
    n = len(centers)
    weights = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if i != j:
                c = centers[i] - centers[j]
                weights[i, j] = math.exp(-(c @ ((metrics[i] + metrics[j]) / 2) @ c) / sigma**2)
    return weights


def laplacian(weights: Array) -> Array:
    """Eq 3: 1 on the diagonal, −w_ij / a_i elsewhere; 0 elsewhere where a_i = 0 (no neighbour)."""
    n = len(weights)
    result = np.eye(n)
    for i in range(n):
        a = sum(weights[i, j] for j in range(n) if j != i)
        for j in range(n):
            if i != j and a > 0:
                result[i, j] = -weights[i, j] / a
    return result


def eigenpairs(operator: Array, n_eigs: int) -> tuple[Array, Array]:
    """L φ_k = λ_k φ_k, the smallest first, ‖φ_k‖ = 1; fewer pairs where L is smaller."""
    if len(operator) == 0:
        return np.zeros(0), np.zeros((0, 0))
    values, vectors = np.linalg.eig(operator)
    order = np.argsort(values.real)[:n_eigs]
    vectors = vectors.real[:, order]
    return values.real[order], vectors / np.linalg.norm(vectors, axis=0)


def chebyshev_polynomial(degree: int, x: float) -> float:
    """T_0 = 1, T_1 = x, T_d = 2 x T_{d−1} − T_{d−2}."""
    if degree < 2:
        return 1.0 if degree == 0 else x
    return 2 * x * chebyshev_polynomial(degree - 1, x) - chebyshev_polynomial(degree - 2, x)


def chebyshev(values: Array, vectors: Array, degree: int) -> Array:
    """Eq 4: g_i^d = Σ_k T_d(λ̃_k) φ_k(i)², λ̃_k = 2 λ_k / λ_max − 1 (−1 where λ_max is 0)."""
    result = np.zeros((len(vectors), degree + 1))
    highest = max(values, default=0.0)
    for i in range(len(vectors)):
        for d in range(degree + 1):
            for k in range(len(values)):
                scaled = 2 * values[k] / highest - 1 if highest > 1e-12 else -1.0
                result[i, d] += chebyshev_polynomial(d, scaled) * vectors[i, k] ** 2
    return result


def turned_laplacian(c: Array, s: Array, angle: float, beta: float, sigma: float) -> Array:
    """L^θ: Eqs 1-3 with M_i^θ = R_θ M_i R_θᵀ, R_θ a turn about the z axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    metrics = [turn @ metric(covariance, beta) @ turn.T for covariance in s]
    return laplacian(edge_weights(c, np.array(metrics), sigma))


def descriptor(c: Array, s: Array, angles: list[float], K: int, D: int, **albo: float) -> Array:
    """Eqs 5-6: the Chebyshev descriptors g^0 .. g^D of each angle, one after another."""
    operators = [turned_laplacian(c, s, a, **albo) for a in angles]
    return np.hstack([chebyshev(*eigenpairs(x, K), D) for x in operators])


def positional_encoding(center: Array, width: int) -> Array:
    """PE(c): sin(2^k π c), then cos(2^k π c), three entries each, for k = 0, 1, ..."""
    entries: list[float] = []
    for k in range(width):
        entries += [math.sin(2**k * math.pi * x) for x in center]
        entries += [math.cos(2**k * math.pi * x) for x in center]
    return np.array(entries[:width])


def tokens(descriptors: Array, centers: Array, token: Array) -> Array:
    """z = [z_0; z_1; ...; z_n] with z_i = f(G_i) + PE(c_i)."""
    pairs = zip(descriptors, centers, strict=True)
    return np.array([token] + [f + positional_encoding(c, len(token)) for f, c in pairs])


def attention(z: Array, query: Array, key: Array, value: Array) -> Array:
    """Eq 7: y'_h = Σ_j softmax_j(q_h · k_j / √d) v_j, the heads' outputs side by side."""
    rows = []
    for i in range(len(z)):
        heads: list[Array] = []
        for h in range(len(query)):
            q, d = z[i] @ query[h], query.shape[2]
            scores = [q @ (z[j] @ key[h]) / math.sqrt(d) for j in range(len(z))]
            exps = [math.exp(score - max(scores)) for score in scores]
            heads.append(sum(e / sum(exps) * (z[j] @ value[h]) for j, e in enumerate(exps)))
        rows.append(np.concatenate(heads))
    return np.array(rows)


def linear(state: State, name: str, x: Array) -> Array:
    """A x + b, with the weights called `name`."""
    return state[name + ".weight"] @ x + state[name + ".bias"]


def layer_norm(state: State, name: str, z: Array) -> Array:
    """Each row less its mean, over its standard deviation, times a weight, plus a bias."""
    rows = [(row - row.mean()) / math.sqrt(row.var() + 1e-5) for row in z]
    return np.array([state[name + ".weight"] * row + state[name + ".bias"] for row in rows])


def gelu(x: Array) -> Array:
    """Each x times the normal distribution's share below it."""
    return np.array([v * 0.5 * (1 + math.erf(v / math.sqrt(2))) for v in x])


def encode(state: State, z: Array, n_layers: int) -> Array:
    """p(S): L layers of attention and feed-forward, then an MLP of the learned token y_0^(L)."""
    for layer in range(n_layers):
        name = f"layers.{layer}."
        heads = (state[name + "query"], state[name + "key"], state[name + "value"])
        z = z + attention(layer_norm(state, name + "norm_attention", z), *heads)
        normed = layer_norm(state, name + "norm_forward", z)
        hidden = [gelu(linear(state, name + "forward_1", row)) for row in normed]
        z = z + np.array([linear(state, name + "forward_2", row) for row in hidden])
    return linear(state, "head_2", gelu(linear(state, "head_1", z[0])))


def exponent(point: Array, center: Array, covariance: Array, tau: float) -> float:
    """−ln ω_i(q) of Eq 8; no eigenvalue of Σ_i below 1e-12 of its largest, nor below 1e-30."""
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, max(1e-12 * values.max(), 1e-30))
    along = vectors.T @ (point - center)
    return sum(a**2 / v for a, v in zip(along, values, strict=True)) / tau


def shares(point: Array, centers: Array, covariances: Array, tau: float) -> list[float]:
    """ω_i(q) / Σ_j ω_j(q) of Eqs 8-9 over the regions that hold q, times e^c / e^c (no 0/0)."""
    pairs = zip(centers, covariances, strict=True)
    exponents = [exponent(point, c, s, tau) for c, s in pairs]
    omegas = [math.exp(min(exponents) - e) for e in exponents]
    return [omega / sum(omegas) for omega in omegas]


def shape_feature(encodings: Array, quotients: Sequence[float]) -> Array:
    """Eq 9: Σ_i (ω_i / Σ_j ω_j) p(S_i) over the regions that hold q; 0 where there are none."""
    terms = [share * p for p, share in zip(encodings, quotients, strict=True)]
    return sum(terms, np.zeros(encodings.shape[1]))


def fuse(state: State, shape: Array, semantic: Array) -> Array:
    """Eq 10, with g(q) a linear map of u(q) = [f_shape, f_sem], as printed."""
    g = linear(state, "linear", np.concatenate([shape, semantic]))
    return g * semantic + (1 - g) * shape


def sigmoid(x: float) -> float:
    """ς(x) = 1 / (1 + e^−x), without overflow."""
    return 1 / (1 + math.exp(-x)) if x >= 0 else math.exp(x) / (1 + math.exp(x))


def soft_mask(state: State, f: Array, phi: float) -> float:
    """m̂_i: f' by the first gate, u = [f', φ], a hidden vector by the second, a linear map, ς."""
    u = np.append([sigmoid(x) for x in linear(state, "gate_features", f)] * f, phi)
    gates = [sigmoid(x) for x in linear(state, "gate_hidden", u)]
    return sigmoid(linear(state, "output", gates * u)[0])


def binary(soft: float, threshold: float) -> float:
    """m_i, and SH's m̂_i^(l): 1 where the soft mask exceeds the threshold, else 0."""
    return 1.0 if soft > threshold else 0.0


def mean(values: Sequence[float] | Array) -> float:
    """Eq 11, (1/|N(c)|) Σ_q ‖∇f(q)‖, and L_mask = (1/N) Σ_i m̂_i; 0 for none."""
    return sum(values) / len(values) if len(values) else 0.0


def candidate_count(volume: float, n_points: int, density: float, most: float) -> int:
    """Eq 12, rounded up: N_p = min(N_max, α_d V_pc / N_ori)."""
    return math.ceil(min(most, density * volume / n_points)) if n_points else 0


def accept(candidate: Array, points: Array, nearest: float, farthest: float) -> tuple[bool, int]:
    """Whether the nearest point lies d_min to d_max away, and which point that is."""
    distances = [math.sqrt(sum((candidate - point) ** 2)) for point in points]
    closest = min(range(len(points)), key=lambda i: distances[i])
    return nearest <= distances[closest] <= farthest, closest


def soft_histogram(values: Array, low: float, high: float, n_bins: int, gamma: float) -> Array:
    """Eq 13: H[b] = Σ_x ς(γ (x − (c_b − Δ/2))) − ς(γ (x − (c_b + Δ/2)))."""
    result = np.zeros(n_bins)
    delta = (high - low) / n_bins
    for b in range(n_bins):
        center = low + delta * (b + 0.5)
        for x in values:
            above = sigmoid(gamma * (x - (center + delta / 2)))
            result[b] += sigmoid(gamma * (x - (center - delta / 2))) - above
    return result


def band_mask(state: State, level: int, f: Array, psi: float, histogram: Array | None) -> float:
    """δ^(l) = ς(linear(v)), v^(l) = [f, ψ^(l), η^(l)(R)], η the MLP of H (0 for no region)."""
    if histogram is None:
        eta = np.zeros(len(state[f"embed.{level}.2.bias"]))
    else:
        hidden = np.maximum(linear(state, f"embed.{level}.0", histogram), 0)
        eta = linear(state, f"embed.{level}.2", hidden)
    v = np.concatenate([f, [psi], eta])
    return sigmoid(linear(state, f"output.{level}", v)[0])


def sh_loss(delta: Array) -> float:
    """L_SH = (1/N) Σ_i Σ_l (2 l + 1) δ_i^(l)."""
    return mean([sum((2 * k + 1) * row[k] for k in range(4)) for row in delta])


def projected(W: Array, B: Array) -> tuple[Array, Array]:
    """Ŵ = B Bᵀ W and R = W − Ŵ."""
    inside = B @ (B.T @ W)
    return inside, W - inside


def projection_error(W: Array, B: Array) -> float:
    """ρ = ‖R‖_F / ‖W‖_F; 0 where W = 0."""
    size = np.linalg.norm(W)
    return float(np.linalg.norm(projected(W, B)[1]) / size) if size > 0 else 0.0


def modulation(state: State, z: Array) -> float:
    """α(z̄): one layer of the mean z̄ = Σ_{i=0}^n z_i / (n + 1), then ς."""
    return sigmoid(linear(state, "linear", sum(z) / len(z))[0])


def regularizer(W: Array, B: Array, alpha: float) -> float:
    """Eq 14: α ‖W − B Bᵀ W‖_F² / ‖W‖_F²."""
    size = (W**2).sum()
    return float(alpha * (projected(W, B)[1] ** 2).sum() / size) if size > 0 else 0.0


def regularizer_gradient(W: Array, B: Array, alpha: float) -> Array:
    """Eq 14 by W: 2 α ((1 − B Bᵀ)ᵀ R / ‖W‖² − ‖R‖² W / ‖W‖⁴)."""
    residual = projected(W, B)[1]
    size = (W**2).sum()
    outside = residual - B @ (B.T @ residual)
    return 2 * alpha * (outside / size - (residual**2).sum() / size * W / size)


def spread(descriptors: Array) -> float:
    """Eq 15: σ_f = √((1/N) Σ_i ‖f(G_i) − f̄‖²)."""
    average = sum(descriptors) / max(len(descriptors), 1)
    return math.sqrt(mean([((f - average) ** 2).sum() for f in descriptors]))


def update(
    W: Array,
    B: Array | None,
    sigma_f: float,
    kappa: float,
    epsilon: float,
    eta: float,
) -> Array:
    """B ← orth([B, U^(r')]) where ρ' = ρ (1 + κ σ_f) > ε; ρ = 1 without a basis."""
    basis = np.zeros((len(W), 0)) if B is None else B
    error = 1.0 if B is None else projection_error(W, B)
    if not W.any() or error * (1 + kappa * sigma_f) <= epsilon:
        return basis
    left, sizes, _ = np.linalg.svd(projected(W, basis)[1])
    kept = 1
    while (sizes[:kept] ** 2).sum() < eta * (sizes**2).sum() and kept < len(sizes):
        kept += 1
    columns = list(basis.T)
    for k in range(kept):
        column = left[:, k]
        for _ in range(2):
            for other in columns:
                column = column - other * (other @ column)
        if np.linalg.norm(column) >= 1e-8:
            columns.append(column / np.linalg.norm(column))
    return np.array(columns).T
