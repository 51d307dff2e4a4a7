"""The knowledge basis stays orthonormal and bounded; extreme weights are cases of the stability suite."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from chebsplat.shape.cks import Growth, Modulation, basis_loss, project, regularizer, spread, update
from chebsplat.shape.encoder import RegionEncoder

ORTHONORMAL = 3e-8  # docs/method.md, section 7: for float32 columns measured in float64


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Matrices this small wait longer for threads than they compute."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def weights(q=32, p=32, rank=None, seed=0):
    g = torch.Generator().manual_seed(seed)
    if rank is None:
        return torch.randn(q, p, generator=g)
    return torch.randn(q, rank, generator=g) @ torch.randn(rank, p, generator=g)


def orthonormality(basis):
    error = basis.double().T @ basis.double() - torch.eye(basis.shape[1], dtype=torch.float64)
    return error.abs().max().item() if error.numel() else 0.0


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    q=st.integers(1, 40),
    p=st.integers(1, 40),
    rank=st.integers(1, 40),
    log_size=st.integers(-25, 25),
    seed=st.integers(0, 10**6),
    fraction=st.floats(0.05, 0.95),
    energy=st.floats(0.01, 1.0),
    rule=st.sampled_from(["total", "residual"]),
)
def test_any_sequence_keeps_rank_bounded_and_columns_orthonormal(q, p, rank, log_size, seed, fraction, energy, rule):
    basis, before = None, 0
    for scene in range(3):
        W = weights(q, p, rank, seed + scene) * 10.0**log_size
        earlier = basis
        basis, report = update(basis, W, Growth(energy=energy, max_rank=fraction, rule=rule))
        assert before <= basis.shape[1] <= fraction * q
        assert earlier is None or torch.equal(basis[:, :before], earlier)
        assert report["added"] == basis.shape[1] - before == report["rank_after"] - report["rank_before"]
        assert 0 <= report["rho_after"] <= report["rho"] * (1 + 1e-9) <= 1 + 1e-9
        assert report["energy"] == pytest.approx(1 - report["rho_after"] ** 2, abs=1e-9)
        assert orthonormality(basis) < 1.2e-7  # one ulp: a column of few entries cannot be rounded better
        before = basis.shape[1]


def test_zero_and_empty_weights_change_nothing():
    basis, report = update(None, torch.zeros(8, 8))
    assert basis.shape == (8, 0)
    assert report["rho"] == 0
    full, _ = update(None, weights(8, 8))
    assert torch.equal(update(full, torch.zeros(8, 8))[0], full)
    assert torch.equal(update(full, torch.zeros(8, 0))[0], full)
    grown, _ = update(basis, weights(8, 8))
    assert grown.shape[1] > 0


@pytest.mark.parametrize("rule", ["total", "residual"])
def test_what_is_already_inside_adds_no_column_and_changes_no_bit(rule):
    basis, _ = update(None, weights(rank=4), Growth(energy=0.999999))
    again, report = update(basis, weights(rank=4), Growth(rule=rule))
    assert report["rho"] < 1e-5
    assert report["added"] == 0
    assert torch.equal(again, basis)


def test_only_the_printed_rule_adds_noise_when_relevance_is_not_asked_for():
    basis, _ = update(None, weights(rank=4), Growth(energy=0.999999))
    noisy = weights(rank=4) + 1e-4 * weights(seed=8)
    assert update(basis, noisy, Growth(rule="residual", tolerance=1e-9, max_added=0.5, n_scenes=1))[1]["added"] == 12
    assert update(basis, noisy, Growth(rule="total", tolerance=1e-9, max_added=0.5, n_scenes=1))[1]["added"] == 0


def test_an_exactly_captured_scene_is_no_update_even_without_tolerance():
    basis = torch.eye(32)[:, :5]
    W = torch.zeros(32, 7, dtype=torch.float64)
    W[:5] = weights(5, 7).double()
    for rule in ("total", "residual"):
        same, report = update(basis, W, Growth(tolerance=0.0, rule=rule))
        assert report["rho"] <= 10 * 2.3e-16 * math.sqrt(32)
        assert torch.equal(same, basis)


@pytest.mark.parametrize("energy", [0.5, 0.9, 0.96])
def test_total_rule_reaches_its_energy_with_as_few_columns_as_it_can(energy):
    W = weights(64, 64, rank=20)
    basis, report = update(None, W, Growth(energy=energy, max_rank=0.9, max_added=1.0, n_scenes=1))
    captured = (project(W, basis)[0] ** 2).sum() / (W.double() ** 2).sum()
    assert report["energy"] == pytest.approx(captured.item(), abs=1e-6)
    assert captured >= energy - 1e-6
    fewer = project(W, basis[:, :-1])[0]
    assert (fewer**2).sum() / (W.double() ** 2).sum() < energy


def test_a_residual_of_a_millionth_that_is_asked_for_is_found_exactly():
    basis = torch.eye(32)[:, :4]
    hidden = torch.nn.functional.normalize(weights(28, 1)[:, 0].double(), dim=0)
    W = torch.zeros(32, 9, dtype=torch.float64)
    W[:4] = weights(4, 9).double()
    W[4:] = 1e-6 * hidden[:, None] * weights(1, 9, seed=2).double()
    grown, report = update(basis, W, Growth(tolerance=1e-9, energy=1 - 1e-15))
    assert report["added"] == 1
    assert abs(grown[4:, 4].double() @ hidden) == pytest.approx(1, abs=1e-6)


def test_relevance_does_not_depend_on_size_or_shape():
    basis, _ = update(None, weights(rank=4), Growth(energy=0.999999))
    W = weights(rank=4) + 0.2 * weights(seed=9)
    rho = update(basis, W)[1]["rho"]
    for other in (W * 1e20, W * 1e-20, torch.cat([W, W], 1), torch.cat([W, torch.zeros(32, 99)], 1)):
        assert update(basis, other)[1]["rho"] == pytest.approx(rho, rel=1e-5)


def test_a_basis_beyond_the_ceiling_is_kept():
    basis = torch.eye(8)[:, :6]
    same, report = update(basis, weights(8, 8), Growth(max_rank=0.5))
    assert torch.equal(same, basis)
    assert report["added"] == 0


def test_captured_and_residual_are_orthogonal_and_add_up():
    basis, _ = update(None, weights(rank=5))
    W = weights(seed=3) * 1e6
    captured, residual = project(W, basis)
    assert torch.allclose(captured + residual, W.double(), rtol=1e-14)
    assert (basis.double().T @ residual).abs().max() < 1e-6  # the basis' own float32 rounding squared, times 1e6
    assert captured.dtype == residual.dtype == torch.float64


def test_the_gradient_of_the_regulariser_is_that_of_its_formula():
    given = {
        "a": weights(16, 24).double().requires_grad_(True),
        "b": weights(8, 8, 3).double().requires_grad_(True),
    }
    bases = {"a": torch.linalg.qr(weights(16, 5).double())[0], "b": torch.linalg.qr(weights(8, 2, seed=1).double())[0]}
    terms = [((W - B @ (B.T @ W)) ** 2).sum() / (W.detach() ** 2).sum()
             for W, B in zip(given.values(), bases.values(), strict=True)]  # fmt: skip
    expected = torch.autograd.grad((terms[0] + terms[1]) / 2, list(given.values()))
    found = torch.autograd.grad(basis_loss(given, bases), list(given.values()))
    for mine, exact in zip(found, expected, strict=True):
        assert torch.allclose(mine, exact, rtol=1e-12, atol=1e-15)


def test_a_basis_spans_the_inputs_that_a_map_reads():
    """Tokens of the first three dimensions alone: the maps z W read these, and write to all."""
    encoder = RegionEncoder(5, 3, width=16, n_layers=1, n_heads=2)
    with torch.no_grad():
        for W in encoder.linear_maps().values():
            W[3:] = 0
    for name, W in encoder.linear_maps().items():
        basis, report = update(None, W.detach(), Growth(energy=0.999999, max_added=1.0, n_scenes=1))
        assert basis.shape == (W.shape[0], 3), name
        assert basis[3:].abs().max() == 0
        assert torch.linalg.matrix_rank(W) == 3 and report["energy"] == pytest.approx(1)
        z = torch.cat([torch.zeros(1, 3), torch.randn(1, len(W) - 3)], 1)
        assert (z @ W).abs().max() == 0 and (z @ basis).abs().max() == 0


def test_the_knowledge_space_follows_inputs_attention_and_decoder():
    encoder = RegionEncoder(5, 3, width=16, n_layers=2, n_heads=2)
    shapes = {name: tuple(W.shape) for name, W in encoder.linear_maps().items()}
    attention = {f"blocks.{k}.{part}": (16, 16) for k in (0, 1) for part in ("query", "key", "value", "output")}
    others = {"embed_position": (27, 16), "embed_input": (5, 16), "hidden": (16, 16)}
    assert shapes == attention | others | {"decode.0": (16, 32), "decode.2": (32, 3)}
    encoder.linear_maps()["embed_input"].sum().backward()
    assert (encoder.embed_input.weight.grad == 1).all()


def printed_share(W, B):
    return ((W - B @ B.T @ W) ** 2).sum() / (W**2).sum()


def printed_alpha(mean, w, b):
    return torch.log(1 + torch.exp((w * mean).sum() + b))


def test_the_modulated_loss_is_the_printed_formula():
    torch.manual_seed(3)
    alpha, W, B = Modulation(7).double(), weights(16, 24).double(), torch.linalg.qr(weights(16, 5).double())[0]
    encodings = torch.randn(40, 7, dtype=torch.float64)
    found = alpha(encodings.mean(0)) * basis_loss({"": W}, {"": B})
    expected = printed_alpha(sum(encodings) / 40, alpha.linear.weight[0], alpha.linear.bias[0]) * printed_share(W, B)
    assert found.item() == pytest.approx(expected.item(), rel=1e-12)


def test_modulation_differs_with_the_shapes_in_view_and_is_taught_by_nothing():
    alpha, W = Modulation(4), weights(8, 8).requires_grad_(True)
    encodings = torch.randn(9, 4, requires_grad=True)
    (alpha(encodings.mean(0)) * regularizer(W, torch.eye(8)[:, :2])).backward()
    assert W.grad is not None and encodings.grad is None
    assert alpha.linear.weight.grad is None and alpha.linear.bias.grad is None
    assert alpha(torch.zeros(4)).item() == pytest.approx(1.0, abs=1e-6)
    assert alpha(torch.ones(4)).item() != pytest.approx(1.0, abs=1e-3)


def test_a_drawn_modulation_leaves_what_is_drawn_after_it_as_it_was():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    Modulation(6)
    assert torch.equal(torch.rand(3), expected)


def test_the_spread_of_shape_is_the_printed_formula_over_members_that_exist():
    g = torch.Generator().manual_seed(0)
    descriptors = torch.randn(6, 9, 2, 5, generator=g, dtype=torch.float64)
    mask = torch.rand(6, 9, generator=g) < 0.6
    mask[4] = False
    descriptors[~mask] = 0
    sigmas = []
    for region, members in zip(descriptors.flatten(2), mask, strict=True):
        if members.any():
            deviation = ((region[members] - region[members].mean(0)) ** 2).mean(0).sqrt()
            sigmas.append(deviation.norm().item() / math.sqrt(10))
    assert spread(descriptors, mask) == pytest.approx(sum(sigmas) / len(sigmas), rel=1e-12)


def test_a_scene_takes_a_share_of_the_room_and_leaves_some_to_those_after_it():
    ranks, basis = [], None
    for seed in range(8):
        basis, report = update(basis, weights(seed=seed), Growth(max_rank=0.875, max_added=0.25, n_scenes=1))
        ranks.append(report["rank_after"])
    assert ranks == [7, 12, 16, 19, 21, 22, 23, 24]


@pytest.mark.parametrize(("q", "ranks"), [(32, [7, 9, *range(10, 29)]), (24, [2, *range(3, 22)]), (8, range(1, 8))])
def test_as_many_scenes_as_asked_for_can_each_add_a_column_where_the_width_allows_it(q, ranks):
    basis, found = None, []
    for seed in range(24):
        basis, report = update(basis, weights(q, q, seed=seed))  # that share nothing
        found.append(report["rank_after"])
        assert (report["added"] > 0) == (seed < len(ranks))
    assert found == [*ranks, *[int(0.875 * q)] * (24 - len(ranks))]


def test_regulariser_is_nothing_before_there_is_knowledge():
    W = weights().requires_grad_(True)
    regularizer(W, torch.zeros(32, 0)).backward()
    assert (W.grad == 0).all()
    assert basis_loss({}, {}).item() == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"W": torch.full((4, 4), torch.nan)}, "not finite"),
        ({"W": torch.full((4, 4), torch.inf)}, "not finite"),
        ({"W": torch.ones(4)}, "not a matrix"),
        ({"basis": torch.eye(5)[:, :2]}, "does not fit"),
        ({"basis": torch.ones(4, 2)}, "not orthonormal"),
        ({"basis": torch.full((4, 1), torch.nan)}, "not orthonormal"),
        ({"rule": "both"}, "neither"),
        ({"update_rule": "both"}, "printed"),
        ({"novelty": math.inf}, "novelty"),
        ({"max_added": 0.0}, "max_added"),
        ({"n_scenes": 0}, "n_scenes"),
        ({"max_rank": 1.0}, "max_rank"),
        ({"energy": 0.0}, "energy"),
    ],
)
def test_what_cannot_be_used_is_refused(arguments, words):
    call = {"basis": None, "W": torch.ones(4, 4)} | arguments
    with pytest.raises(ValueError, match=words):
        update(call.pop("basis"), call.pop("W"), Growth(**call))
