"""Pruning masks, densification and the optimizer's book-keeping."""

import pytest
import torch

from chebsplat import adapt


def raw(n=200, seed=0):
    g = torch.Generator().manual_seed(seed)
    return {
        "means": torch.rand(n, 3, generator=g),
        "log_scales": torch.full((n, 3), -3.0),
        "quats": torch.randn(n, 4, generator=g),
        "logit_opacities": torch.randn(n, generator=g),
        "sh0": torch.randn(n, 1, 3, generator=g),
    }


def test_mask_is_binary_forward_and_soft_backward():
    logits = torch.linspace(-8, 8, 33, requires_grad=True)
    soft = adapt.soft_mask(logits, None)
    hard = adapt.hard_mask(soft)
    assert set(hard.detach().round(decimals=5).tolist()) == {0.0, 1.0}
    hard.sum().backward()
    assert torch.allclose(logits.grad, (soft * (1 - soft)).detach())


def test_extreme_logits_keep_a_gradient_inside_the_clamp_and_stay_finite():
    logits = torch.tensor([-1e30, -9.9, 9.9, 1e30], requires_grad=True)
    adapt.soft_mask(logits, logits.detach()).sum().backward()
    assert torch.isfinite(logits.grad).all()
    assert (logits.grad[1:3] > 0).all()


def test_a_masked_gaussian_has_no_opacity_and_no_size_but_keeps_its_parameters():
    scales, opacities = adapt.apply_mask(torch.tensor([1.0, 0.0]), torch.ones(2, 3), torch.full((2,), 0.5))
    assert scales.tolist() == [[1, 1, 1], [0, 0, 0]]
    assert opacities.tolist() == [0.5, 0.0]


def test_region_gradient_is_the_mean_over_members_not_over_padding():
    gradient = torch.tensor([1.0, 3.0, 5.0])
    members = torch.tensor([[0, 1, -1], [2, -1, -1], [-1, -1, -1]])
    assert adapt.region_gradients(gradient, members).tolist() == [2.0, 5.0, 0.0]


def test_two_gaussians_of_halved_opacity_composite_to_the_one():
    logits = torch.linspace(-5, 5, 21, dtype=torch.float64)
    half = adapt.halved_opacity(logits).sigmoid()
    assert torch.allclose(1 - (1 - half) ** 2, logits.sigmoid())


def test_densify_adds_only_inside_steep_regions_and_within_budget():
    parameters = raw()
    near_zero = parameters["means"].norm(dim=1).argsort()
    members = torch.stack([near_zero[:16], near_zero[-16:]])
    gradient = torch.tensor([1.0, 1e-6])
    generator = torch.Generator().manual_seed(0)
    additions = adapt.densify(parameters, members, gradient, 1e-4, 5, generator)
    assert 0 < len(additions.parents) <= 5
    centre = parameters["means"][members[0]].mean(0)
    radius = (parameters["means"][members[0]] - centre).norm(dim=1).max()
    assert ((additions.rows["means"] - centre).norm(dim=1) <= radius + 1e-5).all()
    assert len(additions.parents.unique()) == len(additions.parents)


@pytest.mark.parametrize("gradient", [0.0, 1e-6])
def test_densify_adds_nothing_where_nothing_is_steep(gradient):
    members = torch.arange(16)[None]
    found = adapt.densify(raw(), members, torch.tensor([gradient]), 1e-4, 5, torch.Generator().manual_seed(0))
    assert len(found.parents) == 0


def test_densify_survives_coincident_points():
    parameters = raw() | {"means": torch.zeros(200, 3)}
    found = adapt.densify(parameters, torch.arange(16)[None], torch.ones(1), 1e-4, 5, torch.Generator().manual_seed(0))
    assert len(found.parents) == 0


def test_clone_keeps_and_split_shrinks():
    parameters = raw()
    parameters["log_scales"][0] = 0.0
    gradient = torch.zeros(200)
    gradient[:2] = 1.0
    found = adapt.clone_or_split(parameters, gradient, 0.5, 0.5, 10, torch.Generator().manual_seed(0))
    by_parent = {int(p): k for k, p in enumerate(found.parents)}
    assert set(by_parent) == {0, 1}
    assert torch.equal(found.rows["means"][by_parent[1]], parameters["means"][1])
    assert (found.rows["log_scales"][by_parent[0]] < 0).all()


def stepped(parameters):
    for value in parameters.values():
        value.requires_grad_(True)
    optimizer = torch.optim.Adam([{"params": [v], "lr": 0.01, "name": k} for k, v in parameters.items()])
    sum((v**2).sum() for v in parameters.values()).backward()
    optimizer.step()
    return optimizer


def test_pruning_keeps_the_moments_of_the_rows_that_stay():
    parameters = raw(10)
    optimizer = stepped(parameters)
    moment = optimizer.state[parameters["means"]]["exp_avg"].clone()
    keep = torch.arange(10) % 2 == 0
    adapt.prune_optimizer(optimizer, parameters, keep)
    assert len(parameters["means"]) == 5
    assert torch.equal(optimizer.state[parameters["means"]]["exp_avg"], moment[keep])
    assert optimizer.param_groups[0]["params"][0] is parameters["means"]
    parameters["means"].sum().backward()
    optimizer.step()


def test_added_rows_and_changed_parents_start_with_zero_moments():
    parameters = raw(10)
    optimizer = stepped(parameters)
    parents = torch.tensor([3, 7])
    rows = {k: v.detach()[parents].clone() for k, v in parameters.items()}
    changed = {"logit_opacities": torch.tensor([-1.0, -2.0])}
    adapt.apply_additions(optimizer, parameters, adapt.Additions(parents, rows, changed))
    assert all(len(v) == 12 for v in parameters.values())
    assert parameters["logit_opacities"][parents].tolist() == [-1.0, -2.0]
    opacity = optimizer.state[parameters["logit_opacities"]]["exp_avg"]
    assert (opacity[[3, 7, 10, 11]] == 0).all()
    means = optimizer.state[parameters["means"]]["exp_avg"]
    assert (means[10:] == 0).all()
    assert (means[3] != 0).any()
