"""Tokens, propagation, growth, knowledge and L1 as printed: against float64 transcriptions, by finite differences."""

import math

import numpy as np
import pytest
import torch
from scipy.special import erf

from chebsplat.shape.encoder import N_FREQUENCIES, RegionEncoder, positional_encoding
from chebsplat.shape.fusion import Fusion, Gate, propagate, propagation_weights
from chebsplat.shape.region_inputs import in_scene
from chebsplat.splats.rotations import rotation_matrices
from chebsplat.training.densify import Candidates, densify, region_gradients
from chebsplat.training.losses import feature_distance, feature_distance_reference
from tests.chebsplat.training.test_printed_gates import randomized
from tests.chebsplat.training.test_printed_gates import weights as arrays

N, M, C = 50, 6, 5
RADIUS = 0.4
DIFFERENCES = {"rtol": 1e-5, "atol": 1e-7}


@pytest.fixture
def room():
    """Points, three regions that may cover each of them, and what is fused there, in float64."""
    rng = np.random.default_rng(0)
    cover = rng.permuted(np.tile(np.arange(M), (N, 1)), axis=1)[:, :3]
    cover[::3, 2] = -1
    cover[::7] = -1
    drawn = {"means": (N, 3), "centers": (M, 3), "features": (N, C), "encodings": (M, C), "quats": (M, 4)}
    given = {name: torch.from_numpy(rng.normal(size=shape)) for name, shape in drawn.items()}
    given["means"], given["centers"] = given["means"].sigmoid(), given["centers"].sigmoid()
    return given | {"scales": torch.from_numpy(0.1 + rng.random((M, 3))), "cover": torch.from_numpy(cover)}


def printed_shape(room, temperature):
    """Eqs 8-9, point by point: weights exp(-|S⁻¹RᵀΔ|² / τ) over their sum, and the encodings that they mix."""
    means, centers, scales, encodings, cover = (
        room[name].numpy() for name in ("means", "centers", "scales", "encodings", "cover")
    )
    rotmats = rotation_matrices(room["quats"]).numpy()
    weights, shape = np.zeros(cover.shape), np.zeros((N, C))
    for i in range(N):
        for k, r in enumerate(cover[i]):
            if r >= 0:
                local = np.diag(1 / scales[r]) @ rotmats[r].T @ (means[i] - centers[r])
                weights[i, k] = math.exp(-local @ local / temperature)
        if (cover[i] >= 0).any():
            weights[i] /= weights[i].sum()
        shape[i] = sum(weight * encodings[r] for weight, r in zip(weights[i], cover[i], strict=True))
    return weights, shape


def printed_fusion(room, gate, temperature):
    """Eq 10 on top: g ⊙ f + (1 - g) ⊙ shape, g = σ(W [shape, f] + b), f alone where nothing covers."""
    w, (_, shape), f = arrays(gate), printed_shape(room, temperature), room["features"].numpy()
    g = 1 / (1 + np.exp(-(np.concatenate([shape, f], 1) @ w["linear.weight"].T + w["linear.bias"])))
    g[room["cover"][:, 0].numpy() < 0] = 1
    return g * f + (1 - g) * shape, g


def weights_of(room, temperature=1.0):
    around = room["means"], room["cover"], room["centers"], rotation_matrices(room["quats"]), room["scales"], RADIUS
    return propagation_weights(*around, inflation=0.0, temperature=temperature)


@pytest.mark.parametrize("temperature", [1.0, 3.0])
def test_printed_propagation_and_gate_are_their_formulas(room, temperature):
    weights, shape = printed_shape(room, temperature)
    found = weights_of(room, temperature)
    assert np.abs(found.numpy() - weights).max() < 1e-12
    assert np.abs(propagate(room["encodings"], room["cover"], found).numpy() - shape).max() < 1e-12
    fusion = Fusion(randomized(Gate(C)), 0.0, temperature)
    order = ("features", "encodings", "cover", "means", "centers", "quats", "scales")
    fused, gate = fusion(*(room[name] for name in order), torch.tensor(RADIUS, dtype=torch.float64))
    for mine, wanted in zip((fused, gate), printed_fusion(room, fusion.gate, temperature), strict=True):
        assert np.abs(mine.detach().numpy() - wanted).max() < 1e-12


def test_gradients_of_printed_propagation_and_gate_agree_with_finite_differences(room):
    fusion = Fusion(randomized(Gate(C)), 0.0, 1.0)
    few = {name: room[name][2:4] for name in ("features", "means", "cover")}
    names = ("features", "means", "encodings", "centers", "quats", "scales")
    leaves = [(few | {k: v for k, v in room.items() if k not in few})[name].clone().requires_grad_() for name in names]

    def fused(features, means, encodings, centers, quats, scales):
        return fusion(features, encodings, few["cover"], means, centers, quats, scales, RADIUS)

    assert torch.autograd.gradcheck(fused, leaves, **DIFFERENCES)
    given = few["features"], room["encodings"][:2], torch.tensor([True, False])

    def gated(weight):
        return torch.func.functional_call(fusion.gate, {"linear.weight": weight}, given)

    weight = fusion.gate.linear.weight.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(gated, weight, **DIFFERENCES)


def test_the_printed_position_is_the_centre_in_its_scene_and_its_octaves():
    means = np.random.default_rng(0).normal(size=(41, 3)) * 7 + 100
    away = means - np.sort(means, 0)[20]
    reach = np.sort(np.abs(away).max(1))
    wanted = away / (reach[38] + 0 * reach[39])  # the quantile of 0.95 of 41 is the 39th
    assert np.abs(in_scene(means) - wanted).max() < 1e-12
    assert np.abs(in_scene(1e3 * means - 5) - wanted).max() < 1e-9  # whatever unit and origin
    positions = torch.from_numpy(wanted).requires_grad_()
    found = positional_encoding(positions)
    angles = [math.pi * 2**k * wanted for k in range(N_FREQUENCIES)]
    columns = [wanted, *(np.sin(a) for a in angles), *(np.cos(a) for a in angles)]
    assert np.abs(found.detach().numpy() - np.concatenate(columns, 1)).max() < 1e-12
    assert torch.autograd.gradcheck(positional_encoding, positions, **DIFFERENCES)


def normalized(x, w, name):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return x * w[f"{name}.weight"] + w[f"{name}.bias"]


def gelu(x):
    return 0.5 * x * (1 + erf(x / math.sqrt(2)))


def linear(x, w, name):
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def printed_encoding(w, inputs, encoded, n_layers, n_heads):
    """Eq 7 for one region without padding: a transformer on tokens of descriptor and PE(c_i), head by head."""
    tokens = linear(gelu(linear(encoded, w, "embed_position") + linear(inputs, w, "embed_input")), w, "hidden")
    tokens = np.concatenate([w["region_token"][None], tokens])
    width = tokens.shape[1] // n_heads
    for depth in range(n_layers):
        block = {name.removeprefix(f"blocks.{depth}."): value for name, value in w.items()}
        x = normalized(tokens, block, "norm_attention")
        q, k, v = (linear(x, block, f"attention.{part}") for part in ("query", "key", "value"))
        heads = []
        for head in range(n_heads):
            part = slice(head * width, (head + 1) * width)
            scores = np.exp(q[:, part] @ k[:, part].T / math.sqrt(width))
            heads.append(scores / scores.sum(1, keepdims=True) @ v[:, part])
        tokens = tokens + linear(np.concatenate(heads, 1), block, "attention.output")
        x = normalized(tokens, block, "norm_forward")
        tokens = tokens + linear(gelu(linear(x, block, "forward_1")), block, "forward_2")
    region = normalized(tokens[0], w, "norm")
    return linear(gelu(linear(region, w, "decode.0")), w, "decode.2")


def test_the_encoder_is_its_formula_and_finite_differences_confirm_its_gradient():
    encoder = randomized(RegionEncoder(7, C, width=8, n_layers=2, n_heads=2))
    rng = np.random.default_rng(0)
    inputs, positions = (torch.from_numpy(0.5 * rng.normal(size=(2, 6, k))) for k in (7, 3))
    mask = torch.arange(6).expand(2, 6) < torch.tensor([[6], [4]])
    found = encoder(inputs, positions, mask).detach().numpy()
    for region, n in enumerate((6, 4)):
        encoded = positional_encoding(positions[region, :n]).numpy()
        wanted = printed_encoding(arrays(encoder), inputs[region, :n].numpy(), encoded, 2, 2)
        assert np.abs(found[region] - wanted).max() < 1e-12
    leaves = inputs.requires_grad_(), positions.requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: encoder(*given, mask), leaves, **DIFFERENCES)


def test_a_region_gradient_is_the_printed_mean_and_finite_differences_confirm_its_own():
    g = np.random.default_rng(0).random(N)
    gradients = torch.from_numpy(g).requires_grad_()
    members = torch.tensor([[0, 3, 9], [4, -1, -1], [-1, -1, -1]])
    wanted = [(g[0] + g[3] + g[9]) / 3, g[4], 0.0]
    assert np.abs(region_gradients(gradients, members).detach().numpy() - wanted).max() < 1e-12
    assert torch.autograd.gradcheck(lambda given: region_gradients(given, members), gradients, **DIFFERENCES)


@pytest.mark.parametrize("excess", [0.3, 1.5, 2.0])
def test_the_printed_growth_is_density_times_volume_times_excess_within_the_ball(excess):
    """A count: it has no gradient. Of 6000 Gaussians, no two candidates are nearest to the same one."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(6000, 3, generator=g)
    raw = {"means": means, "quats": torch.randn(6000, 4, generator=g), "log_scales": torch.full((6000, 3), -4.0)}
    members = means[:, 0].argsort()[:20][None]
    centre = means[members[0]].double().mean(0)
    radius = float((means[members[0]].double() - centre).norm(dim=1).max())
    density = 6.1 / (4 / 3 * math.pi * radius**3)
    raw["logit_opacities"], gradient = torch.zeros(6000), torch.tensor([2 * (1 + excess)], dtype=torch.float64)
    bounds = {"nearest": 1e-6, "farthest": 1e6, "max_candidates": 1000}
    generator = torch.Generator().manual_seed(3)
    added = densify(raw, members, gradient, 2.0, 10_000, generator, Candidates(density=density, printed=True, **bounds))
    assert len(added.parents) == math.ceil(6.1 * excess)
    assert ((added.rows["means"].double() - centre).norm(dim=1) <= radius * (1 + 1e-5)).all()


def test_l1_of_features_is_its_formula_and_finite_differences_confirm_its_gradient():
    rng = np.random.default_rng(0)
    render, target = rng.normal(size=(6, 8, C)), rng.normal(size=(3, 4, C))
    pooled = np.array([[render[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].mean((0, 1)) for j in range(4)] for i in range(3)])
    wanted = np.abs(pooled - target).mean()
    given = torch.from_numpy(render), torch.from_numpy(target)

    def distance(render):
        return feature_distance_reference(render, given[1], kind="l1")

    assert abs(float(distance(given[0])) - wanted) < 1e-12
    assert abs(float(feature_distance(*(value.float() for value in given), kind="l1")) - wanted) < 1e-6
    assert torch.autograd.gradcheck(distance, given[0].requires_grad_(), **DIFFERENCES)
