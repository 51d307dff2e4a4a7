"""The printed method in the trainer: each part takes part, and each row of Table 5 leaves out one
thing.
"""

import chebsplat  # noqa: F401  # isort: skip
import numpy as np
import pytest
import torch

from benchmarks.stability.training import tiny_trainer
from chebsplat.printed.encoding import Encoder, PointMLP

SHORT = {"method": "printed", "steps": 6, "prune_from": 0.0}


def trained(**settings):
    made = tiny_trainer(**SHORT | settings)
    figures = list(made.steps())
    return made, figures


def test_every_loss_and_every_module_takes_part():
    made, figures = trained()
    assert {"loss_color", "loss_features", "loss_mask", "loss_sh"} <= set(figures[-1])
    before = tiny_trainer(**SHORT).model.printed.state_dict()
    after = made.model.printed.state_dict()
    still = {name for name in before if torch.equal(before[name], after[name])}
    # there is no basis yet
    assert {name.partition(".")[0] for name in still} <= {"modulation", "in_view"}


def test_masks_teach_the_features_that_guide_them():
    made = tiny_trainer(**SHORT)
    for linear in (made.model.printed.pruning.output, *made.model.printed.band_masks.output):
        torch.nn.init.ones_(linear.weight)
    rendered = made.model.render(made.views.camera(0, 1), 3)
    for loss in (rendered.auxiliary.soft_mask.sum(), rendered.auxiliary.delta.sum()):
        features = made.model.raw["features"]
        assert (
            torch.autograd.grad(loss, features, retain_graph=True, allow_unused=True)[0] is not None
        )
    assert len(rendered.auxiliary.soft_mask) == len(rendered.auxiliary.delta) == len(made.model)


@pytest.mark.parametrize(
    "without", ["descriptor", "transformer", "pruning guidance", "SH guidance", "densification"]
)
def test_a_row_of_table_5_leaves_out_one_thing(without):
    made, _ = trained(without=without)
    parts = made.model.printed
    kind = PointMLP if without in ("descriptor", "transformer") else Encoder
    assert isinstance(parts.encoder, kind)
    assert (parts.pruning is None) == (without == "pruning guidance")
    assert (parts.band_masks is None) == (without == "SH guidance")
    assert made.grows_by_color == (without == "pruning guidance")
    assert (made.settings.densify == "off") == (without == "densification")
    described = made.model.whole().descriptors
    assert bool(described.any()) == (without != "descriptor")


@pytest.mark.parametrize("reading", ["means", "features"])
def test_new_gaussians_are_their_neighbours_elsewhere(reading, monkeypatch):
    monkeypatch.setattr("chebsplat.training.printed.STEEP_FEATURES", 0.0)
    made = tiny_trainer(**SHORT | {"region_gradient": reading, "n_densify": 0})
    for _ in made.steps():
        pass
    gradient = made.population.gradient_sum / made.population.gradient_count.clamp_min(1)
    assert gradient.max() > 0
    added = made.model.additions(gradient, 1e-12, 50, torch.Generator().manual_seed(0))
    assert 0 < len(added.parents) <= 50 and not added.changed
    for name, values in added.rows.items():
        same = torch.equal(values, made.model.raw[name][added.parents])
        assert same == (name != "means"), name


def test_what_is_stored_is_fused_and_closed_bands_are_gone():
    made = tiny_trainer(**SHORT)
    for _ in made.steps():
        pass
    with torch.no_grad():
        made.model.raw["sh_logits"][::2, 0] = -50.0  # the lowest band, of every other Gaussian
        made.model.raw["sh_logits"][:, 2] = -50.0
        made.model.raw["sh_logits"][:, 3] = 50.0
        for linear in made.model.printed.band_masks.output:
            linear.weight.zero_()
            linear.weight[0, made.model.raw["features"].shape[1]] = 1.0
    is_open = made.model._open()
    assert (
        not is_open[::2, 0].any()
        and is_open[1::2, 0].all()
        and is_open[:, 3].all()
        and not is_open[:, 2].any()
    )
    own = made.model.raw["features"].detach().clone()
    stored = made.finish()
    assert (stored["degrees"] == 3).all()  # bands are not nested
    assert not stored["shN"][:, 3:8].any() and stored["shN"][:, 8:].any()
    closed = ~stored["sh0"].any((1, 2))
    assert closed.sum() == (~is_open[:, 0]).sum()
    assert not np.allclose(stored["features"], own.numpy())


def test_knowledge_of_a_scene_pulls_the_next_and_grows():
    first, _ = trained()
    bases = first.model.grown_bases()
    assert set(bases) == set(first.model.printed.encoder.key_projections())
    for basis in bases.values():
        assert torch.allclose(basis.mT @ basis, torch.eye(basis.shape[1]), atol=1e-5)
    second = tiny_trainer(**SHORT | {"seed": 1})
    second.model.bases = bases
    pull = second.model.render(second.views.camera(0, 1), 3).auxiliary.knowledge
    layers = second.model.printed.encoder.layers
    assert all(slope.any() for slope in torch.autograd.grad(pull, [one.key for one in layers]))
    figures = list(second.steps())
    assert figures[0]["loss_knowledge"] > 0
    grown = second.model.grown_bases()
    for name, basis in bases.items():
        assert torch.equal(grown[name][:, : basis.shape[1]], basis)
        assert grown[name].shape[1] > basis.shape[1]


def test_a_resumed_training_ends_as_an_uninterrupted_one():
    whole, _ = trained(steps=8)
    first = tiny_trainer(**SHORT | {"steps": 8})
    steps = first.steps()
    for _ in range(4):
        next(steps)
    second = tiny_trainer(**SHORT | {"steps": 8})
    second.load_state_dict(first.state_dict())
    for _ in second.steps():
        pass
    for name, value in whole.model.raw.items():
        assert torch.equal(value, second.model.raw[name]), name


def test_histograms_are_shares_of_masks_in_ten_bins():
    made, _ = trained()
    found = made.model.histograms()
    assert set(found) == {"gate", "mask", "sh0", "sh1", "sh2", "sh3"}
    counts = torch.histc(made.model.soft_mask(), 10, 0, 1)
    assert found["mask"] == pytest.approx((counts / len(made.model)).tolist())
    assert all(sum(found[f"sh{band}"]) == pytest.approx(1) for band in range(4))
