"""Refreshing what changed gives what refreshing everything gives."""

import pytest
import torch

from chebsplat.shape.branch import ShapeBranch
from chebsplat.stages.runtime.config import Config


def scene(n=600, seed=0):
    g = torch.Generator().manual_seed(seed)
    raw = {"means": torch.rand(n, 3, generator=g) * torch.tensor([5.0, 4.0, 1.0])}
    raw |= {"log_scales": torch.randn(n, 3, generator=g) * 0.5 - 3, "quats": torch.randn(n, 4, generator=g)}
    return raw | {"features": torch.randn(n, 6, generator=g)}


def shape_of(**train):
    config = Config.model_validate({"describe": {"n_regions": 40, "region_size": 12}, "train": train})
    torch.manual_seed(0)
    return ShapeBranch(6, config.describe, config.train)


def full(shape, raw):
    """What all of the present regions' descriptors are, computed at once."""
    fresh = shape_of()
    fresh.refresh(raw, shape.regions)
    return fresh


def described_by(shape, raw):
    before = shape.described.n_described
    shape.refresh(raw)
    return shape.described.n_described - before


def assert_same(shape, raw):
    fresh = full(shape, raw)
    assert torch.equal(shape.descriptors, fresh.descriptors)
    assert torch.equal(shape.cache, fresh.cache)


def test_nothing_is_described_anew_where_nothing_changed():
    shape, raw = shape_of(), scene()
    assert described_by(shape, raw) == 40
    assert described_by(shape, raw) == 0


@pytest.mark.parametrize("name", ["means", "log_scales", "quats"])
def test_refresh_touches_only_what_changed_and_equals_a_full_one(name):
    shape, raw = shape_of(), scene()
    shape.refresh(raw)
    touched = [int(i) for i in shape.members[3, 2:5]]
    raw[name][touched] += 1e-3
    n = described_by(shape, raw)
    assert 0 < n < 20
    assert_same(shape, raw)


def test_added_and_removed_gaussians_touch_only_their_regions():
    shape, raw = shape_of(), scene()
    shape.refresh(raw)
    keep = torch.ones(600, dtype=torch.bool)
    keep[[int(shape.members[3, 4]), int(shape.centers[7])]] = False
    near = raw["means"][int(shape.centers[11])]
    raw = {name: value[keep] for name, value in raw.items()}
    shape.keep(keep)
    raw = {name: torch.cat([value, value[:2]]) for name, value in raw.items()}
    raw["means"][-2:] = near + 0.01
    n = described_by(shape, raw)
    assert 0 < n < 30
    assert len(shape.regions.centers) == 40  # the lost centre has a successor
    assert_same(shape, raw)


def test_anew_owes_nothing_to_earlier_refreshes():
    shape, raw = shape_of(), scene()
    shape.refresh(raw)
    raw["means"] = raw["means"] * 1.3
    shape.refresh(raw)
    shape.refresh(raw, anew=True)
    fresh = shape_of()
    fresh.refresh(raw)
    assert torch.equal(shape.descriptors, fresh.descriptors)
    assert torch.equal(shape.members, fresh.members)


def test_removal_that_was_not_announced_is_an_error():
    shape, raw = shape_of(), scene()
    shape.refresh(raw)
    with pytest.raises(ValueError, match="not announced"):
        shape.refresh({name: value[:-1] for name, value in raw.items()})


def test_a_position_is_an_offset_in_the_region_the_place_in_the_scene_or_both():
    raw = scene()
    region, center, both = (shape_of(position=position) for position in ("region", "center", "both"))
    for shape in (region, center, both):
        shape.refresh(raw)
    assert torch.equal(both.positions, torch.cat([region.positions, center.positions], -1))
    assert region.positions[region.members >= 0].norm(dim=-1).max() <= 1 + 1e-5
    away = raw["means"] - raw["means"].quantile(0.5, dim=0, interpolation="midpoint")
    place = away / away.abs().amax(1).quantile(0.95)
    assert torch.allclose(center.positions, place[center.members.clamp_min(0)], atol=1e-5)
    moved = raw | {"means": 7 * raw["means"] + 100}
    again = shape_of(position="center")
    again.refresh(moved | {"log_scales": raw["log_scales"] + 7**0.5}, center.regions._replace(radius=7.0))
    assert torch.allclose(again.positions, center.positions, atol=1e-4)  # of no unit and no origin
    assert both.encode(raw["features"], torch.arange(3)).shape == (3, 6)


def test_the_paper_s_no_agcd_sees_positions_alone():
    shape, raw = shape_of(encoder="mlp", albo=False, context="none"), scene()
    shape.refresh(raw)
    assert shape.encoder.n_inputs == 0
    assert len(shape.encoder.blocks) == 0
    assert not torch.equal(shape.cache[0], shape.cache[1])
    other = {"features": -raw["features"], "log_scales": raw["log_scales"] - 1, "quats": raw["quats"].flip(1)}
    again = shape_of(encoder="mlp", albo=False, context="none")
    again.refresh(raw | other)
    assert torch.equal(shape.cache, again.cache)
