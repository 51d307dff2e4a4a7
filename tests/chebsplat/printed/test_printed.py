"""The printed modules against the paper's formulas in plain numpy (oracles.py)."""

import math

import numpy as np
import pytest
import torch

from chebsplat.printed import (
    densification,
    descriptor,
    encoding,
    fusion,
    knowledge,
    propagation,
    pruning,
    sh_pruning,
)

from . import oracles
from .inputs import (
    ALBO,
    ANGLES,
    ONE,
    PLACES,
    agree,
    all_pairs,
    basis_for,
    both,
    make_regions,
    matrices,
    padded,
    randomise,
    regions,
    room,
    samples,
    single,
    some_pairs,
    tensor,
    turned_ellipsoids,
)


@both
@regions
def test_metric_and_edge_weights(kind: str, dtype: torch.dtype) -> None:
    found = make_regions(kind)
    metrics = []
    for _, s in found:
        wanted = np.reshape([oracles.metric(x, 2.0) for x in s], s.shape)
        agree(descriptor.metric(tensor(s, dtype), 2.0), wanted, 1)
        metrics.append(single(wanted))
    centers, present = padded([c for c, _ in found], 8, 1, 1e3)
    given = (tensor(x, dtype) for x in (centers, padded(metrics, 8, 1, 1e3)[0], present))
    weights = descriptor.edge_weights(*given, 1.5)
    for r, (c, _) in enumerate(found):
        wanted = np.zeros((8, 8))
        wanted[np.ix_(present[r], present[r])] = oracles.edge_weights(c, metrics[r], 1.5)
        agree(weights[r], wanted, 1)


@both
@regions
def test_laplacian_and_eigenpairs(kind: str, dtype: torch.dtype) -> None:
    graphs = []
    for c, s in make_regions(kind):
        metrics = np.array([oracles.metric(x, 2.0) for x in s])
        graphs.append(single(oracles.edge_weights(c, metrics, 1.5)))
    padded_graphs, present = padded(graphs, 8, 2, 0)
    given = (tensor(padded_graphs, dtype), tensor(present))
    operators = descriptor.laplacian(*given)
    for n_eigs in (1, 4, 20):
        found, vectors = descriptor.eigenpairs(*given, n_eigs)
        assert found.shape[-1] == min(n_eigs, 8)
        for r, graph in enumerate(graphs):
            operator = oracles.laplacian(graph)
            wanted = np.zeros((8, 8))
            wanted[np.ix_(present[r], present[r])] = operator
            agree(operators[r], wanted, 1)
            values, wanted = oracles.eigenpairs(operator, n_eigs)
            n = len(values)
            agree(found[r, :n], values, 4)
            phi = vectors[r, present[r], :n].double().numpy()
            assert not (found[r, n:].any() or vectors[r, :, n:].any())
            assert not vectors[r, ~present[r]].any()
            agree(tensor(np.linalg.norm(phi, axis=0), dtype), np.ones(n))
            agree(tensor(operator @ phi, dtype), phi * found[r, :n].double().numpy(), 4)
            if size := room(oracles.eigenpairs(operator, 8)[0], n_eigs, dtype):
                agree(tensor(phi**2, dtype), wanted**2, size)


@both
@pytest.mark.parametrize("weight", [1e-6, 1e-12, 1e-20, 1e-30, 1e-60, 1e-200])
def test_a_weakly_attached_member_is_still_attached(weight: float, dtype: torch.dtype) -> None:
    graph = np.random.default_rng(0).uniform(0.2, 1, (6, 6))
    graph = single((graph + graph.T) * (1 - np.eye(6)))
    graph[0] *= weight
    graph[:, 0] *= weight
    graph = tensor(graph, dtype).double().numpy()
    values, phi = descriptor.eigenpairs(tensor(graph, dtype), torch.ones(6, dtype=torch.bool), 3)
    phi = phi.double().numpy()
    agree(tensor(oracles.laplacian(graph) @ phi, dtype), phi * values.double().numpy(), 4)


@both
@matrices
def test_chebyshev(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 4):
        values = np.sort(rng.uniform(0, 2, 4))
        for scaled in (single(values * scale) for scale in (1, 0, 1e-8, -1e-16)):
            found = descriptor.chebyshev(tensor(scaled, dtype), tensor(x, dtype), 5)
            agree(found, oracles.chebyshev(scaled, x, 5), float((x**2).sum()))


@both
@regions
def test_descriptor(kind: str, dtype: torch.dtype) -> None:
    found = make_regions(kind)
    centers, present = padded([c for c, _ in found], 8, 1, 1e3)
    covariances = padded([s for _, s in found], 8, 1, 0)[0] + ONE * ~present[..., None, None]
    given = [tensor(x, dtype) for x in (centers, covariances, present, ANGLES)]
    compared = 0
    for n_eigs in (3, 20):
        actual = descriptor.descriptor(*given, **ALBO, n_eigs=n_eigs, degree=4)
        assert actual.shape == (len(found), 8, 15) and not actual[~given[2]].any()
        for r, (c, s) in enumerate(found):
            members = actual[r, present[r]]
            # g^0 is Σ_k φ_k(i)², so it sums to the number of eigenpairs
            agree(members[:, ::5].sum(0), [min(n_eigs, len(c))] * 3)
            operators = [oracles.turned_laplacian(c, s, a, **ALBO) for a in ANGLES]
            sizes = [room(oracles.eigenpairs(x, 8)[0], n_eigs, dtype) for x in operators]
            if all(sizes):
                wanted = oracles.descriptor(c, s, ANGLES, n_eigs, 4, **ALBO)
                agree(members, wanted, max(sizes))
                compared += 1
    assert compared >= (30 if dtype == torch.float32 else 80) or kind != "random"


@pytest.mark.parametrize("padding", [0.0, 1e3, 1e30])
def test_nothing_reads_padding(padding: float) -> None:
    rng = np.random.default_rng(0)
    dtype, present = torch.float32, torch.tensor([[True, True, True, False, False]])
    centers, covariances = torch.full((1, 5, 3), padding), torch.full((1, 5, 3, 3), padding)
    centers[:, :3], covariances[:, :3] = tensor(rng.normal(size=(3, 3)), dtype), torch.eye(3)
    randomise(encoder := encoding.Encoder(8, 5, 2, 2), rng, dtype)
    results = []
    for n in (5, 3):
        c, s, held = centers[:, :n], covariances[:, :n], present[:, :n]
        angles = torch.tensor([0.0, 0.5])
        f = descriptor.descriptor(c, s, held, angles, **ALBO, n_eigs=3, degree=3)
        f[~held] = padding
        z = encoder.tokens(f, c)
        z[:, 1:][~held] = padding
        results.append((f[:, :3], knowledge.spread(f, held), encoder(z, held)))
    for with_padding, without in zip(*results, strict=True):
        agree(with_padding, without.detach().numpy())


@both
@matrices
def test_positional_encoding_and_tokens(kind: str, dtype: torch.dtype) -> None:
    for rng, centers in samples(kind, 6, 3):
        size = 1 + 4 * math.pi * np.abs(centers).max(initial=0)
        for width in (1, 8, 14):
            wanted = [oracles.positional_encoding(c, width) for c in centers]
            found = encoding.positional_encoding(tensor(centers, dtype), width)
            agree(found, np.reshape(wanted, (-1, width)), size)
        token = randomise(encoder := encoding.Encoder(16, 5, 1, 2), rng, dtype)["token"]
        f = single(rng.normal(size=(len(centers), 16)))
        found = encoder.tokens(tensor(f, dtype), tensor(centers, dtype))
        agree(found, oracles.tokens(f, centers, token), size)


@both
@matrices
def test_attention_and_encoder(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 5, 8):
        rows = np.vstack([single(rng.normal(size=(1, 8))), x])
        present = np.append(True, rng.random(len(x)) < 0.7)
        z, held = tensor(rows, dtype)[None], tensor(present)[None]
        heads = single(0.3 * rng.normal(size=(3, 2, 8, 3)))
        found = encoding.attention(z, *tensor(heads, dtype), held)[0]
        size = max(1, np.abs(rows).max())
        agree(found[present], oracles.attention(rows[present], *heads), size)
        for h in range(2):
            alone = encoding.attention(z, *tensor(heads[:, h : h + 1], dtype), held)[0]
            agree(found[:, 3 * h : 3 * h + 3], alone.double().numpy())
        state = randomise(encoder := encoding.Encoder(8, 5, 2, 2), rng, dtype)
        found = encoder(z, held[:, 1:])[0]
        agree(found, oracles.encode(state, rows[present], 2), size)


@both
@pytest.mark.parametrize("kind", ["random", *PLACES])
def test_weights_count_every_region(kind: str, dtype: torch.dtype) -> None:
    for seed in range(50 if kind == "random" else 1):
        rng = np.random.default_rng(seed)
        q, c = rng.uniform(-1, 1, (7, 3)), rng.uniform(-1, 1, (9, 3))
        place = (q, c, turned_ellipsoids(rng, 9))
        *place, tau = PLACES[kind](*place) if kind in PLACES else (*place, 2.0)
        q, c, s = (single(x) for x in place)
        for points, of in (all_pairs(len(q), len(c)), some_pairs(rng, len(q), len(c))):
            given = (tensor(x, dtype) for x in (q, c, s))
            found = propagation.weights(*given, (points, of), tau)
            assert found.shape == points.shape
            for p in set(points.tolist()):
                inside = of[points == p].numpy()
                agree(found[points == p], oracles.shares(q[p], c[inside], s[inside], tau), 1)


@both
@matrices
def test_propagate(kind: str, dtype: torch.dtype) -> None:
    for rng, p in samples(kind, 9, 5):
        for points, of in (all_pairs(6, len(p)), some_pairs(rng, 6, len(p))):
            w = single(rng.uniform(0, 1, len(points)))
            found = propagation.propagate(tensor(p, dtype), tensor(w, dtype), (points, of), 6)
            at = [(points == q).numpy() for q in range(6)]
            agree(found, [oracles.shape_feature(p[of.numpy()[a]], w[a]) for a in at])


@both
@matrices
def test_gate(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 8):
        state = randomise(gate := fusion.Gate(4), rng, dtype)
        rows = (x[:, :4], x[:, 4:], rng.random(len(x)) < 0.7)
        found = gate(*(tensor(v, dtype) for v in rows))
        columns = zip(*rows, strict=True)
        wanted = [oracles.fuse(state, f, s) if held else s for f, s, held in columns]
        agree(found, np.reshape(wanted, (-1, 4)))


@both
@matrices
def test_pruning(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 5):
        state = randomise(gate := pruning.PruningGate(4), rng, dtype)
        features, phi = tensor(x[:, :4], dtype).requires_grad_(), tensor(x[:, 4], dtype)
        soft = gate(features, phi)
        agree(soft, [oracles.soft_mask(state, row[:4], row[4]) for row in x], 1)
        agree(pruning.mask_loss(soft), oracles.mean(soft.detach().double().numpy()), 1)
        mask = pruning.binarize(soft, 0.5)
        assert not pruning.binarize(tensor([0.5], dtype), 0.5).any()
        binary = np.array([oracles.binary(m, 0.5) for m in soft.tolist()])
        agree(mask, binary)
        s, a = single(rng.uniform(1, 2, (len(x), 3))), single(rng.uniform(0, 1, len(x)))
        scales, opacities = pruning.apply_mask(mask, tensor(s, dtype), tensor(a, dtype))
        agree(scales, binary[:, None] * s)
        agree(opacities, binary * a)
        total = scales.sum() + opacities.sum()
        # the binary mask passes its gradient on as it is
        agree(torch.autograd.grad(total, soft, retain_graph=True)[0], s.sum(1) + a)
        slope = torch.autograd.grad(total, features)[0]
        assert kind not in ("random", "tiny", "two rows") or (slope != 0).any(1).all()


@both
@matrices
def test_mean_gradients_and_candidate_counts(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 1):
        lengths, pairs = np.abs(x[:, 0]), some_pairs(rng, len(x), 9)
        inside = [pairs[0].numpy()[pairs[1].numpy() == r] for r in range(9)]
        found = densification.mean_gradients(tensor(lengths, dtype), pairs, 9)
        agree(found, [oracles.mean(lengths[i]) for i in inside])
        n = rng.integers(0, 4, len(x))
        found = densification.candidate_counts(tensor(lengths, dtype), tensor(n), 3.3, 20)
        rows = zip(lengths, n.tolist(), strict=True)
        assert found.dtype == torch.int64
        assert found.tolist() == [oracles.candidate_count(v, k, 3.3, 20) for v, k in rows]


@both
@matrices
def test_candidates(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 40, 3):
        generator = torch.Generator().manual_seed(1)
        far = densification.in_ball(tensor(x, dtype), 0.7, generator) - tensor(x, dtype)
        assert far.shape == x.shape and far.dtype == dtype
        limit = 0.7 + 1e-6 * np.abs(x).max(initial=1)
        assert (torch.linalg.norm(far, dim=1) <= limit).all()
        points = single(rng.normal(size=(5, 3)))
        given = (tensor(x, dtype), tensor(points, dtype))
        for low, high in ((0.3, 1.1), (0.0, 1e9), (1.1, 0.3), (2.0, 2e3)):
            kept, parents = densification.accepted(*given, low, high)
            wanted = [oracles.accept(c, points, low, high) for c in x]
            assert kept.tolist() == [k for k, _ in wanted] and parents.dtype == torch.int64
            far = [np.linalg.norm(points[i] - c) for c, (_, i) in zip(x, wanted, strict=True)]
            agree(tensor(np.linalg.norm(points[parents.numpy()] - x, axis=1), dtype), far)


def test_candidates_fill_the_ball_and_may_share_a_parent() -> None:
    centers = torch.ones(20000, 3, dtype=torch.float64)
    drawn = densification.in_ball(centers, 2.0, torch.Generator().manual_seed(0)) - 1
    shares = (torch.linalg.norm(drawn, dim=1) / 2) ** 3  # even over [0, 1] in a ball
    assert torch.histc(shares, 10, 0, 1).sub(2000).abs().max() < 200
    assert drawn.mean(0).abs().max() < 0.05
    candidates = tensor([[1.0, 0, 0], [0, 2, 0], [0, 1.5, 0], [0, 0, 0], [0, 0, 2.25]])
    kept, parents = densification.accepted(candidates, tensor([[0.0, 0, 0], [9, 0, 0]]), 1, 2)
    assert kept.tolist() == [True, True, True, False, False] and parents.tolist() == [0] * 5


@both
@matrices
def test_soft_histogram(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 4, 6):
        across = np.ptp(x) if x.size else 0
        low = single(x.min(initial=1e9) - across * rng.uniform(0, 1, len(x)))
        high = single(low + across * rng.uniform(0.5, 2, len(x)))
        rows = (x, rng.random(x.shape) < 0.8, low, high)
        for gamma in (3.0, 1e3):
            found = sh_pruning.soft_histogram(*(tensor(v, dtype) for v in rows), 8, gamma)
            each = zip(*rows, strict=True)
            wanted = [oracles.soft_histogram(v[p], a, b, 8, gamma) for v, p, a, b in each]
            size = 6 * (gamma if dtype == torch.float32 else 1)
            agree(found, np.reshape(wanted, (-1, 8)), size)
            assert across or not found.any()


@both
@matrices
def test_band_masks(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 8):
        state = randomise(masks := sh_pruning.BandMasks(4, 8, 3), rng, dtype)
        features, psi = (tensor(v, dtype).requires_grad_() for v in (x[:, :4], x[:, 4:]))
        for n_regions in (3, 0):
            histograms = single(rng.uniform(0, 3, (n_regions, 4, 8)))
            region = rng.integers(-1, n_regions, len(x))
            delta = masks(features, psi, tensor(histograms, dtype), tensor(region))
            wanted = [
                oracles.band_mask(state, k, v[:4], v[4 + k], histograms[r, k] if r >= 0 else None)
                for v, r in zip(x, region, strict=True)
                for k in range(4)
            ]
            agree(delta, np.reshape(wanted, (-1, 4)), 1)
            agree(sh_pruning.sh_loss(delta), oracles.sh_loss(delta.detach().double().numpy()), 16)
        # also where a mask is closed, and of ψ^(0) as well as the others
        slopes = torch.autograd.grad(pruning.binarize(delta, 0.5).sum(), (features, psi))
        if kind in ("random", "tiny", "two rows"):
            assert (slopes[0] != 0).any(1).all() and (slopes[1] != 0).all()


@pytest.mark.parametrize("closed", [(0,), (1,), (0, 3), (1, 2), (0, 1, 2, 3)])
def test_any_band_closes_alone(closed: tuple[int, ...]) -> None:
    masks = sh_pruning.BandMasks(4)
    psi = torch.full((2, 4), 50.0)
    psi[:, list(closed)] = -50.0
    for output in masks.output:
        output.weight.data.fill_(0)
        output.weight.data[:, 4] = 1
    delta = masks(torch.ones(2, 4), psi, torch.ones(1, 4, 8), torch.tensor([0, -1]))
    assert (delta > 0.5).tolist() == [[k not in closed for k in range(4)]] * 2


@both
@matrices
@pytest.mark.parametrize("rank", [0, 2, 9])
def test_projection_and_regularizer(kind: str, rank: int, dtype: torch.dtype) -> None:
    for rng, w in samples(kind, 6, 4):
        b, alpha = basis_for(rng, len(w), rank), 0.75
        W, B = tensor(w, dtype).requires_grad_(), tensor(b, dtype)
        for found, wanted in zip(knowledge.projected(W, B), oracles.projected(w, b), strict=True):
            agree(found, wanted, np.abs(w).max(initial=0))
        agree(knowledge.projection_error(W, B), oracles.projection_error(w, b), 1)
        loss = knowledge.regularizer(W, B, tensor(alpha, dtype))
        agree(loss, oracles.regularizer(w, b, alpha), 1)
        if w.any():
            slope = oracles.regularizer_gradient(w, b, alpha)
            agree(torch.autograd.grad(loss, W)[0], slope, 1 / np.linalg.norm(w))
            step = 1e-5 * np.linalg.norm(w) * rng.normal(size=w.shape)
            rise = [oracles.regularizer(w + x, b, alpha) for x in (step, -step)]
            assert rise[0] - rise[1] == pytest.approx(2 * (slope * step).sum(), abs=1e-12)
        elif loss.requires_grad:
            assert torch.autograd.grad(loss, W)[0].isfinite().all()


@both
@matrices
def test_spread_and_modulation(kind: str, dtype: torch.dtype) -> None:
    for rng, x in samples(kind, 6, 8):
        size = max(1, np.abs(x).max(initial=0))
        present = rng.random(len(x)) < 0.7
        found = knowledge.spread(tensor(x, dtype)[None], tensor(present)[None])
        agree(found, [oracles.spread(x[present])], 3 * size)
        state = randomise(layer := knowledge.Modulation(8), rng, dtype)
        z = np.vstack([single(rng.normal(size=(1, 8))), x])
        held = np.append(True, present)
        found = layer(tensor(z, dtype)[None], tensor(held)[None])
        agree(found, [oracles.modulation(state, z[held])], size if dtype == torch.float32 else 1)


def test_spread_is_not_divided_by_the_width() -> None:
    f = torch.stack([torch.ones(16), -torch.ones(16)])
    assert knowledge.spread(f, torch.tensor([True, True])).item() == pytest.approx(4)


@both
@matrices
@pytest.mark.parametrize("rank", [None, 0, 2, 9])
def test_update(kind: str, rank: int | None, dtype: torch.dtype) -> None:
    for rng, w in samples(kind, 6, 4):
        b = None if rank is None else basis_for(rng, len(w), rank)
        B = None if b is None else tensor(b, dtype)
        for sigma_f, epsilon in ((0.0, 0.3), (0.5, 0.9), (2.0, 1e-3), (0.0, 0.0)):
            settings = {"sigma_f": sigma_f, "kappa": 0.5, "epsilon": epsilon, "eta": 0.9}
            found = knowledge.update(tensor(w, dtype), B, **settings)
            wanted = oracles.update(w, b, **settings)
            assert found.shape == wanted.shape and found.dtype == dtype
            agree(found @ found.T, wanted @ wanted.T, 5)
            agree(found.T @ found, np.eye(found.shape[1]), 1 if dtype == torch.float32 else 1e4)


@pytest.mark.parametrize(("eta", "columns"), [(0.05, 1), (0.45, 5), (0.75, 8), (0.99, 10)])
def test_update_takes_columns_until_the_energy_is_reached(eta: float, columns: int) -> None:
    w = tensor(np.linalg.qr(np.random.default_rng(0).normal(size=(30, 10)))[0])
    for b in (None, torch.zeros(30, 0, dtype=torch.float64)):
        assert knowledge.update(w, b, 0, kappa=1, epsilon=0.5, eta=eta).shape[1] == columns
