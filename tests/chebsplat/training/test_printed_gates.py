"""The printed pruning gate and SH mask network: against their formulas, and by finite differences."""

import numpy as np
import pytest
import torch

from benchmarks.stability.training import tiny_trainer
from chebsplat.splats.sh import basis
from chebsplat.stages.training.facts import guidance
from chebsplat.training import prune, sh_mask_network
from chebsplat.training.sh_mask_network import BandMaskNetwork, nested, region_histograms

N, C, M = 40, 5, 6


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def randomized(module, seed=0):
    torch.manual_seed(seed)
    module = module.double()
    for value in module.parameters():
        torch.nn.init.normal_(value, std=0.7)
    return module


def weights(module):
    return {name: value.detach().numpy() for name, value in module.named_parameters()}


@pytest.fixture
def scene():
    rng = np.random.default_rng(3)
    members = rng.permuted(np.tile(np.arange(N), (M, 1)), axis=1)[:, :7]
    members[2, 4:] = members[4] = -1
    return {
        "features": torch.from_numpy(rng.normal(size=(N, C))),
        "logits": torch.from_numpy(rng.normal(size=N)),
        "band_logits": torch.from_numpy(rng.normal(size=(N, 3))),
        "coefficients": torch.from_numpy(0.3 * rng.normal(size=(N, 16, 3))),
        "directions": torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(N, 3))), dim=-1),
        "members": torch.from_numpy(members),
        "nearest": torch.from_numpy(rng.integers(-1, M, N)),
    }


def test_pruning_gate_is_its_formula(scene):
    gate = randomized(prune.PrintedGate(C))
    w, f, phi = weights(gate), scene["features"].numpy(), scene["logits"].numpy()
    gated = sigmoid(f @ w["gate_features.weight"].T + w["gate_features.bias"]) * f
    u = np.concatenate([gated, phi[:, None]], 1)
    hidden = sigmoid(u @ w["gate_hidden.weight"].T + w["gate_hidden.bias"]) * u
    wanted = sigmoid(hidden @ w["output.weight"].T + w["output.bias"])[:, 0]
    assert np.abs(gate(scene["features"], scene["logits"]).detach().numpy() - wanted).max() <= 1e-12


def histogram(values, n_bins):
    """Of Eq 13, one region, one band: value by value."""
    low, high = values.min(), values.max()
    width = max((high - low) / n_bins, 1e-6)
    below = [sigmoid(20 * (b - (values - low) / width)).mean() for b in range(1, n_bins)]
    return np.diff([0, *below, 1])


def test_band_masks_are_their_formula(scene):
    network = randomized(BandMaskNetwork(C, n_bins=4, width=3))
    found = region_histograms(scene["coefficients"], scene["directions"], scene["members"], 4)
    values = basis(scene["directions"], 3).numpy()
    c, w = scene["coefficients"].numpy(), weights(network)
    wanted = np.zeros((M, 4, 4))
    for region, members in enumerate(scene["members"].numpy()):
        members = members[members >= 0]
        for band in range(4 if len(members) else 0):
            rows = slice(band**2, (band + 1) ** 2)
            colors = np.einsum("nk,nkc->nc", values[members, rows], c[members, rows])
            wanted[region, band] = histogram(colors, 4)
    assert np.abs(found.numpy() - wanted).max() <= 1e-12
    delta = network(scene["band_logits"], scene["features"], found, scene["nearest"]).detach().numpy()
    for i in range(N):
        eta = np.zeros(12)
        region = int(scene["nearest"][i])
        for band in range(4 if region >= 0 else 0):
            hidden = np.maximum(w[f"embed.{band}.0.weight"] @ wanted[region, band] + w[f"embed.{band}.0.bias"], 0)
            eta[3 * band : 3 * band + 3] = w[f"embed.{band}.2.weight"] @ hidden + w[f"embed.{band}.2.bias"]
        v = np.concatenate([scene["features"][i].numpy(), scene["band_logits"][i].numpy(), eta])
        assert np.abs(delta[i] - sigmoid(w["output.weight"] @ v + w["output.bias"])).max() <= 1e-12
    loss = (delta * [1, 3, 5, 7]).sum(1).mean()
    assert abs(float(sh_mask_network.sh_loss(torch.from_numpy(delta))) - loss) <= 1e-12


def test_gradients_of_both_gates_agree_with_finite_differences(scene):
    gate, network = randomized(prune.PrintedGate(C)), randomized(BandMaskNetwork(C, n_bins=4, width=3))
    few = torch.arange(6)
    features, logits = (scene[name][few].clone().requires_grad_() for name in ("features", "logits"))
    assert torch.autograd.gradcheck(lambda *a: gate(*a), (features, logits), rtol=1e-5, atol=1e-8)
    members = scene["members"][:2, :3]
    used, index = members.unique(return_inverse=True)
    coefficients = scene["coefficients"][used].clone().requires_grad_()
    bands = scene["band_logits"][few].clone().requires_grad_()

    def masks(coefficients, bands):
        found = region_histograms(coefficients, scene["directions"][used], index, 4)
        return network(bands, scene["features"][few], found, torch.tensor([0, 1, 0, 1, -1, 0]))

    assert torch.autograd.gradcheck(masks, (coefficients, bands), rtol=1e-5, atol=1e-8)


def test_both_start_alike_for_all_and_as_the_logits_alone_would():
    features = torch.randn(N, C)
    started = prune.PrintedGate(C)(features, torch.ones(N))
    ours = prune.soft_mask(torch.ones(N), prune.SemanticGate(C)(features))
    assert torch.allclose(started, ours, atol=1e-6)
    logits = torch.randn(N, 3)
    delta = BandMaskNetwork(C)(logits, features, torch.rand(M, 4, 8), torch.zeros(N, dtype=torch.int64))
    assert torch.allclose(delta[:, 1:], logits.sigmoid())
    assert (delta[:, 0] > 0.9).all()


def test_penalties_reach_gate_and_histogram_weights_only_where_guidance_is_on(scene):
    coefficients = scene["coefficients"].clone().requires_grad_()
    found = region_histograms(coefficients, scene["directions"], scene["members"], 8)
    guided = randomized(BandMaskNetwork(C))
    sh_mask_network.sh_loss(guided(scene["band_logits"], scene["features"], found, scene["nearest"])).backward()
    assert all(value.grad.abs().max() > 0 for value in guided.parameters())
    assert coefficients.grad.abs().max() > 0
    gate = randomized(prune.PrintedGate(C))
    gate(scene["features"], scene["logits"]).mean().backward()  # L_mask
    assert all(value.grad.abs().max() > 0 for value in gate.parameters())
    alone = randomized(BandMaskNetwork(C, guided=False))
    delta = alone(scene["band_logits"], None, None, scene["nearest"])
    assert torch.equal(delta, alone(scene["band_logits"], -scene["features"], found, scene["nearest"]))
    assert {name for name, _ in alone.named_parameters()} == {"output.weight", "output.bias"}


def test_masks_are_nested_binary_and_pass_the_gradient_of_what_they_threshold():
    delta = torch.tensor([[0.9, 0.05, 0.9, 0.9], [0.05, 0.9, 0.9, 0.05], [0.5, 0.4, 0.3, 0.9]], requires_grad=True)
    masks = nested(delta)
    assert masks.detach().tolist() == [[1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 1, 1]]
    masks.sum().backward()
    assert (delta.grad > 0).all()


def test_what_guidance_changed_is_read_off_a_finished_training():
    features = np.repeat(np.eye(2, dtype=np.float32), 30, axis=0)
    fused = features.copy()
    fused[:6] = [0, 1]
    degrees = np.r_[np.full(30, 3), np.zeros(30)].astype(np.uint8)
    parameters = {"features": features, "fused": fused, "degrees": degrees}
    mask = np.r_[np.full(30, 0.9), np.full(30, 0.5)].astype(np.float32)
    found = guidance(parameters, mask, np.eye(2, dtype=np.float32))
    assert found["labels_changed"] == 0.1
    assert found["mask_spread"] == pytest.approx((0.9 - (30 * 0.5 + 6 * 0.9) / 36) / 2)
    assert found["band_spread"] == pytest.approx((1 - (30 / 16 + 6) / 36) / 2)
    alone = guidance({"features": features, "degrees": degrees}, None, np.eye(2, dtype=np.float32))
    assert alone["labels_changed"] is None and alone["mask_spread"] is None


def test_without_guidance_a_training_has_no_gate_and_no_histogram_to_teach():
    chosen = {"prune_gate": "printed", "sh_masks": "printed"}
    guided, alone = tiny_trainer(**chosen), tiny_trainer(**chosen, prune_semantic=False, sh_guided=False)
    assert isinstance(guided.model.semantic_gate, prune.PrintedGate)
    assert guided.model.band_network.guided
    assert alone.model.semantic_gate is None
    assert not alone.model.band_network.guided and not hasattr(alone.model.band_network, "embed")
    rates = {group["name"]: group["rate"] for group in guided.optimizer.param_groups}
    assert rates["gates"] == 1e-2 != rates["modules"]
