"""Pruning masks, densification and the optimizer's book-keeping."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chebsplat.splats.rotations import rotation_matrices
from chebsplat.training import densify, optimizer_rows, prune


def raw(n=200, seed=0):
    g = torch.Generator().manual_seed(seed)
    return {
        "means": torch.rand(n, 3, generator=g),
        "log_scales": torch.full((n, 3), -3.0),
        "quats": torch.randn(n, 4, generator=g),
        "logit_opacities": torch.randn(n, generator=g),
        "sh0": torch.randn(n, 1, 3, generator=g),
        "prune_logits": torch.randn(n, generator=g),
    }


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def grow(parameters, members, gradient, budget=50, threshold=1e-4, seed=0, **options):
    candidates = densify.Candidates(**options)
    return densify.densify(
        parameters, members, gradient, threshold, budget, seeded(seed), candidates
    )


def spacing_of(parameters):
    """Median over the Gaussians of the mean distance to the nearest three."""
    means = parameters["means"].double()
    return torch.cdist(means, means).topk(4, largest=False).values[:, 1:].mean(1).median()


# masks


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_mask_is_exactly_binary_forward_and_soft_backward(dtype):
    logits = torch.linspace(-8, 8, 333, dtype=dtype, requires_grad=True)
    soft = prune.soft_mask(logits)
    hard = prune.hard_mask(soft)
    assert set(hard.detach().tolist()) == {0.0, 1.0}
    assert torch.equal(hard.detach() == 1, soft.detach() > prune.THRESHOLD)
    hard.sum().backward()
    assert torch.allclose(logits.grad, (soft * (1 - soft)).detach())


# densification by regions


def test_a_gradient_that_is_nan_outside_a_region_does_not_reach_it():
    found = densify.region_gradients(
        torch.tensor([torch.nan, 2.0]), torch.tensor([[1, -1], [0, 1]])
    )
    assert found[0] == 2
    assert densify.region_gradients(torch.zeros(0), torch.full((1, 3), -1)).tolist() == [0.0]
    assert len(grow(raw(), torch.arange(16)[None], found[1:]).parents) == 0


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    n=st.integers(4, 300),
    n_regions=st.integers(1, 6),
    budget=st.integers(0, 40),
    log_size=st.floats(-6, 6),
    flat=st.booleans(),
    bounds=st.tuples(st.floats(0.05, 1.0), st.floats(1.1, 4.0)),
    seed=st.integers(0, 10**6),
)
def test_additions_keep_their_promises(n, n_regions, budget, log_size, flat, bounds, seed):
    parameters = raw(n, seed)
    parameters["means"] = parameters["means"] * 10.0**log_size
    if flat:
        parameters["means"][:, 2] = 0
    members = torch.randint(-1, n, (n_regions, 12), generator=seeded(seed))
    gradient = 1e-3 * torch.rand(n_regions, generator=seeded(seed + 1))
    nearest, farthest = bounds
    found = grow(
        parameters, members, gradient, budget, 2e-4, seed, nearest=nearest, farthest=farthest
    )
    count = len(found.parents)
    assert count <= budget
    assert set(found.rows) == set(parameters)
    assert all(len(v) == count and torch.isfinite(v).all() for v in found.rows.values())
    assert set(found.changed) == {"logit_opacities", "log_scales"}
    assert len(found.parents.unique()) == count
    if not count:
        return
    new, old = found.rows["means"].double(), parameters["means"].double()
    distance, _ = torch.cdist(new, old, compute_mode="donot_use_mm_for_euclid_dist").min(1)
    assert torch.allclose(distance, (new - old[found.parents]).norm(dim=1), rtol=1e-3)
    three = (
        torch.cdist(old, old, compute_mode="donot_use_mm_for_euclid_dist")
        .topk(4, largest=False)
        .values[:, 1:]
    )
    spacing = three.mean(1)
    assert (distance >= 0.99 * nearest * spacing.min()).all()
    assert (distance <= 1.01 * farthest * spacing.max()).all()
    inside = torch.zeros(count, dtype=torch.bool)
    for region in range(n_regions):
        ball = old[members[region][members[region] >= 0]]
        if gradient[region] > 2e-4 and len(ball):
            radius = (ball - ball.mean(0)).norm(dim=1).max()
            inside |= (new - ball.mean(0)).norm(dim=1) <= radius * (1 + 1e-4)
    assert inside.all()
    for name in ("quats", "sh0", "prune_logits"):
        assert torch.equal(found.rows[name], parameters[name][found.parents])
    parents = {name: value[found.parents] for name, value in parameters.items()}
    offsets = found.rows["means"] - parents["means"]
    logits, log_scales, quats = (parents[k] for k in ("logit_opacities", "log_scales", "quats"))
    shared = densify.shared_opacity(logits, log_scales, quats, offsets)
    torch.testing.assert_close(found.rows["logit_opacities"], shared, rtol=0, atol=1e-3)
    shared = densify.shared_scales(log_scales, quats, offsets)
    torch.testing.assert_close(found.rows["log_scales"], shared, rtol=0, atol=1e-3)
    assert all(torch.equal(values, found.rows[name]) for name, values in found.changed.items())


def test_new_gaussians_keep_apart_from_each_other():
    parameters = raw(401)
    options = {"density": 1.0, "max_candidates": 2000}
    found = grow(parameters, torch.arange(401)[None], torch.ones(1), 400, **options)
    new = found.rows["means"].double()
    assert len(new) > 30
    assert (torch.cdist(new, new) + torch.eye(len(new))).min() >= 0.5 * spacing_of(parameters)


def test_steeper_regions_come_first_where_the_budget_is_short():
    parameters = raw(400)
    halves = torch.arange(400).reshape(2, 200)
    parameters["means"][200:] += 10
    for steeper in (0, 1):
        gradient = torch.full((2,), 2e-4)
        gradient[steeper] = 1e-3
        parents = grow(parameters, halves, gradient, 5).parents
        assert len(parents) == 5
        assert torch.isin(parents, halves[steeper]).all()


def test_candidates_are_as_many_as_eq_12_has_whatever_the_unit_and_fill_the_ball(monkeypatch):
    drawn, draw = [], densify._in_unit_ball
    monkeypatch.setattr(densify, "_in_unit_ball", lambda *of: drawn.append(draw(*of)) or drawn[-1])
    parameters, members = raw(1001), torch.arange(1001)[None]
    away = parameters["means"].double() - parameters["means"].double().mean(0)
    whole = 4 / 3 * math.pi * (away.norm(dim=1).max() / spacing_of(parameters)) ** 3
    for unit, gradient, most, wanted in (
        (1, 1.25e-4, 10**6, whole / 4), (1, 1.25e-4, 7, 7), (1, 2e-4, 10**6, whole),
        (100, 5e-4, 10**6, whole),
    ):  # fmt: skip
        scaled = parameters | {"means": unit * parameters["means"]}
        options = {"budget": 1000, "density": 1.0, "max_candidates": most}
        grow(scaled, members, torch.tensor([gradient]), **options)
        assert len(drawn[-1]) == pytest.approx(wanted, abs=1)
    shares = torch.from_numpy(drawn[-1]).norm(dim=1) ** 3  # even over [0, 1]
    counts = torch.histc(shares, 10, 0, 1)
    assert counts.sum() == len(shares) > 5000
    assert counts.sub(len(shares) / 10).abs().max() < 0.02 * len(shares)


def test_densify_is_fixed_by_its_generator_and_leaves_its_input_alone():
    parameters = raw()
    before = {name: value.clone() for name, value in parameters.items()}
    members, gradient = torch.arange(200).reshape(5, 40), torch.ones(5)
    a, b, c = (grow(parameters, members, gradient, seed=s) for s in (3, 3, 4))
    assert torch.equal(a.rows["means"], b.rows["means"])
    assert a.rows["means"].shape != c.rows["means"].shape or not torch.equal(
        a.rows["means"], c.rows["means"]
    )
    assert all(torch.equal(value, before[name]) for name, value in parameters.items())


NO_REGION = {"members": torch.zeros(0, 16, dtype=torch.int64), "gradient": torch.zeros(0)}
NOTHING = {
    "flat gradient": {"gradient": torch.zeros(1)},
    "below threshold": {"gradient": torch.tensor([1e-6])},
    "no budget": {"budget": 0},
    "no regions": NO_REGION,
    "empty region": {"members": torch.full((1, 16), -1)},
    "one member": {"members": torch.tensor([[5, -1, -1]])},
    "coincident": {"parameters": raw() | {"means": torch.zeros(200, 3)}},
    "three Gaussians": {"parameters": raw(3), "members": torch.arange(3)[None]},
    "none": {"parameters": raw(0)} | NO_REGION,
}


@pytest.mark.parametrize("changed", NOTHING.values(), ids=NOTHING)
def test_densify_adds_nothing_where_there_is_no_reason_or_no_room(changed):
    given = {"members": torch.arange(16)[None], "gradient": torch.ones(1), "parameters": raw()}
    found = grow(**(given | changed))
    assert len(found.parents) == 0
    assert all(rows.shape == (0, *raw(3)[name].shape[1:]) for name, rows in found.rows.items())


def test_gaussians_that_are_not_finite_neither_stop_growth_nor_have_offspring():
    parameters = raw()
    parameters["means"][::7] = torch.nan
    parameters["means"][1] = torch.inf
    found = grow(parameters, torch.arange(200).reshape(5, 40), torch.ones(5))
    assert len(found.parents) > 5
    assert torch.isfinite(parameters["means"][found.parents]).all()
    assert torch.isfinite(found.rows["means"]).all()


def test_bounds_out_of_order_are_refused():
    for options in ({"threshold": 0.0}, {"nearest": 2.0}, {"nearest": 0.0}):
        with pytest.raises(ValueError, match=r"is not positive|does not hold"):
            grow(raw(), torch.arange(16)[None], torch.ones(1), **options)


# two that render like the one


def test_opacity_at_the_old_centre_stays_whatever_the_offset():
    logits = torch.linspace(-5, 5, 21, dtype=torch.float64)
    quats = torch.randn(21, 4, generator=seeded(), dtype=torch.float64)
    log_scales = torch.randn(21, 3, generator=seeded(1), dtype=torch.float64)
    for size in (0.0, 0.5, 2.0, 1e6):
        offsets = size * torch.randn(21, 3, generator=seeded(2), dtype=torch.float64)
        shared = densify.shared_opacity(logits, log_scales, quats, offsets).sigmoid()
        local = torch.einsum("nji,nj->ni", rotation_matrices(quats), offsets) / log_scales.exp()
        falloff = torch.exp(-0.5 * (local**2).sum(1))
        assert torch.allclose(
            1 - (1 - shared) * (1 - falloff * shared), logits.sigmoid(), atol=1e-6
        )
    in_place = densify.shared_opacity(logits, log_scales, quats, 0 * offsets).sigmoid()
    assert torch.allclose(in_place, 1 - (1 - logits.sigmoid()).sqrt())


def test_scales_shrink_only_along_the_offset_and_keep_the_second_moment():
    log_scales = torch.tensor([[0.0, 0.0, -2.0]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    shared = densify.shared_scales(
        log_scales, quats, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    ).exp()
    assert shared[0, 0] ** 2 + 0.25 == pytest.approx(1.0)
    assert shared[0, 1:].tolist() == pytest.approx([1.0, math.exp(-2)])


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e3, 1e18])
def test_sharing_stays_finite_for_any_offset_scale_and_quaternion(size):
    n = 8
    quats = torch.randn(n, 4, generator=seeded())
    quats[0] = 0
    log_scales = torch.linspace(-80, 80, 3 * n).reshape(n, 3)
    logits = torch.linspace(-100, 100, n)
    offsets = size * torch.randn(n, 3, generator=seeded(1))
    assert torch.isfinite(densify.shared_opacity(logits, log_scales, quats, offsets)).all()
    scales = densify.shared_scales(log_scales, quats, offsets)
    assert torch.isfinite(scales).all()
    assert (log_scales - scales).max() <= math.log(densify.SHRINK) + 1e-4


# the classic baseline


def test_classic_candidates_are_steep_and_parted_by_size():
    parameters = raw(10)
    parameters["log_scales"][3] = 0.0
    gradients = torch.tensor([0.0, 2, 3, 4, 0, 1, 0, 0, 0, 5])
    parameters["means"][9] = torch.nan
    clones, splits = densify.classic_candidates(parameters, gradients, 0.5, 0.5)
    assert clones.tolist() == [2, 1, 5]
    assert splits.tolist() == [3]


def test_clone_keeps_and_split_shrinks():
    parameters = raw()
    parameters["log_scales"][0] = 0.0
    gradient = torch.zeros(200)
    gradient[:2] = 1.0
    found = densify.clone_or_split(parameters, gradient, 0.5, 0.5, 10, seeded())
    by_parent = {int(p): k for k, p in enumerate(found.parents)}
    assert set(by_parent) == {0, 1}
    for name, value in found.rows.items():
        assert torch.equal(value[by_parent[1]], parameters[name][1])
    assert torch.allclose(found.rows["log_scales"][by_parent[0]], torch.tensor(-math.log(1.6)))
    assert not torch.equal(found.rows["means"][by_parent[0]], found.changed["means"][by_parent[0]])


def test_halves_of_splits_are_drawn_from_the_gaussian_that_is_split():
    parameters = {
        name: value[:1].expand(20_000, *value.shape[1:]).clone() for name, value in raw().items()
    }
    parameters["log_scales"][:] = torch.tensor([-1.0, -2.0, -3.0])
    found = densify.clone_or_split(parameters, torch.ones(20_000), 0.5, 0.01, 20_000, seeded())
    frame = rotation_matrices(parameters["quats"][:1])[0]
    for means in (found.rows["means"], found.changed["means"]):
        local = (means - parameters["means"]) @ frame
        # 1/√(2N) = 0.5 %
        assert torch.allclose(local.std(0), torch.tensor([-1.0, -2.0, -3.0]).exp(), rtol=0.03)


def test_classic_takes_the_steepest_within_budget():
    gradient = torch.arange(200.0)
    found = densify.clone_or_split(raw(), gradient, 0.5, 0.06, 7, seeded())
    assert sorted(found.parents.tolist()) == list(range(193, 200))
    assert len(densify.clone_or_split(raw(), gradient, 0.5, 0.06, 0, seeded()).parents) == 0


# rows of parameters and optimizer


def stepped(parameters, **options):
    for value in parameters.values():
        value.requires_grad_(True)
    groups = [{"params": [v], "lr": 0.01, "name": k} for k, v in parameters.items()]
    module = torch.nn.Linear(10, 3)
    groups.append({"params": list(module.parameters()), "lr": 0.01, "name": "modules"})
    optimizer = torch.optim.Adam(groups, **options)
    (sum((v**2).sum() for v in parameters.values()) + module(torch.ones(10)).sum()).backward()
    optimizer.step()
    return optimizer


@pytest.mark.parametrize("options", [{}, {"amsgrad": True}, {"fused": True}])
def test_rows_keep_their_moments_and_new_ones_start_at_zero(options):
    parameters = raw(10)
    optimizer = stepped(parameters, **options)
    before = {k: dict(optimizer.state[v]) for k, v in parameters.items()}
    weight = optimizer.param_groups[-1]["params"][0]
    parameters["ids"] = torch.arange(10)  # not optimised
    rows = {k: v.detach()[:3] + 1 for k, v in parameters.items()}
    both = {k: torch.cat([v.detach(), rows[k]]) for k, v in parameters.items()}
    optimizer_rows.extend_optimizer(optimizer, parameters, rows)
    keep = torch.arange(13) % 2 == 0
    optimizer_rows.prune_optimizer(optimizer, parameters, keep)
    assert all(torch.equal(value, both[name][keep]) for name, value in parameters.items())
    assert not parameters.pop("ids").requires_grad
    for index, (name, value) in enumerate(parameters.items()):
        assert value.is_leaf
        assert optimizer.param_groups[index]["params"][0] is value
        for key, state in optimizer.state[value].items():
            old = before[name][key]
            wanted = old if state.ndim == 0 else torch.cat([old[::2], torch.zeros_like(old[:2])])
            assert torch.equal(state, wanted)
    assert optimizer.param_groups[-1]["params"][0] is weight
    assert len(optimizer.state) == len(parameters) + 2
    sum(v.sum() for v in parameters.values()).backward()
    optimizer.step()


def test_rows_can_come_and_go_before_the_first_step_and_down_to_none():
    parameters = raw(4)
    for value in parameters.values():
        value.requires_grad_(True)
    optimizer = torch.optim.Adam([{"params": [v], "name": k} for k, v in parameters.items()])
    optimizer_rows.extend_optimizer(
        optimizer, parameters, {k: v.detach()[:2] for k, v in parameters.items()}
    )
    optimizer_rows.prune_optimizer(optimizer, parameters, torch.zeros(6, dtype=torch.bool))
    assert all(len(v) == 0 and v.requires_grad for v in parameters.values())


def test_rows_that_lack_a_parameter_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        optimizer_rows.append(raw(5), {"means": raw(3)["means"]})


def test_added_rows_and_changed_parents_start_with_zero_moments():
    parameters = raw(10)
    optimizer = stepped(parameters)
    parents = torch.tensor([3, 7])
    rows = {k: v.detach()[parents].clone() for k, v in parameters.items()}
    changed = {"logit_opacities": torch.tensor([-1.0, -2.0]), "quats": rows["quats"].clone()}
    optimizer_rows.apply_additions(optimizer, parameters, densify.Additions(parents, rows, changed))
    assert all(len(v) == 12 for v in parameters.values())
    assert parameters["logit_opacities"][parents].tolist() == [-1.0, -2.0]
    opacity = optimizer.state[parameters["logit_opacities"]]["exp_avg"]
    assert (opacity[[3, 7, 10, 11]] == 0).all()
    for untouched in ("means", "quats"):
        moment = optimizer.state[parameters[untouched]]["exp_avg"]
        assert (moment[10:] == 0).all()
        assert (moment[3] != 0).any()
