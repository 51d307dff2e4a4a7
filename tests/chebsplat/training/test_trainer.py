"""A training keeps rows, moments and bands together, whatever comes and goes."""

import chebsplat  # noqa: F401  # isort: skip
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from shared import ROOT
from thread_counts import assert_same_bits

from benchmarks.stability.training import four_views, tiny_trainer
from chebsplat.errors import DataFailure
from chebsplat.settings import TrainSection
from chebsplat.splats.exposure import exposed
from chebsplat.stages.sfm import default_points
from chebsplat.stages.training.defaults import Evidence, resolved
from chebsplat.training import schedule as schedules
from chebsplat.training import sh_prune
from chebsplat.training.schedule import Schedule, rates
from chebsplat.views import Window


def test_closed_bands_leave_parameters_and_moments_and_the_picture_stays():
    made = tiny_trainer(sh_freeze=0.9, steps=20, densify="off", prune_from=0.0)
    steps = made.steps()
    for _ in range(17):
        next(steps)
    raw = made.model.raw
    with torch.no_grad():
        raw["sh_logits"].copy_(
            torch.randn(raw["sh_logits"].shape, generator=torch.Generator().manual_seed(3)) * 6
        )
    degrees = sh_prune.degrees(sh_prune.band_mask(raw["sh_logits"].detach()))
    moments = {name: dict(made.optimizer.state[value]) for name, value in raw.items()}
    before, means = made.model.render(made.views.camera(0, 1), 3).rgb, raw["means"].detach().clone()
    made.population.freeze_bands(made.optimizer)
    after = made.model.render(made.views.camera(0, 1), 3).rgb
    assert (after - before).abs().max() < 2e-6  # the order of equal depths may change
    order = torch.argsort(degrees, descending=True, stable=True)
    assert torch.equal(raw["means"], means[order])
    for name, value in raw.items():
        assert len(value) == (
            int((degrees >= int(name[2])).sum()) if name in ("sh1", "sh2", "sh3") else len(order)
        )
        state = made.optimizer.state[value]
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key], moments[name][key][order[: len(value)]])
    assert "sh_logits" not in raw and "sh_logits" not in {
        g["name"] for g in made.optimizer.param_groups
    }
    assert 0 < len(raw["sh3"]) < len(raw["sh2"]) < len(raw["sh1"]) < len(order)
    for _ in steps:  # trains on
        pass
    parameters = made.finish()
    assert np.array_equal(parameters["degrees"], degrees[order].numpy())
    absent = np.arange(1, 16) >= (parameters["degrees"][:, None] + 1) ** 2
    assert not parameters["shN"][absent].any()


@pytest.mark.parametrize("steps", [1, 6])
def test_a_training_of_few_steps_does_not_grow_after_the_freeze(steps):
    made = tiny_trainer(
        steps=steps, n_densify=12, max_gaussians=3000, lr_sh_masks=0.0, densify="classic"
    )
    with torch.no_grad():
        made.model.raw["sh_logits"][::2] = -8.0
    for _ in made.steps():
        pass
    assert made.population.n_grown < 12 and len(made.finish()["degrees"]) == len(made.model)


def test_a_band_that_nobody_keeps_is_gone():
    made = tiny_trainer(densify="off")
    with torch.no_grad():
        made.model.raw["sh_logits"].copy_(
            torch.tensor([8.0, -8.0, 8.0]).expand_as(made.model.raw["sh_logits"])
        )
    made.population.freeze_bands(made.optimizer)
    assert {"sh2", "sh3"}.isdisjoint(made.model.raw) and len(made.model.raw["sh1"]) == len(
        made.model
    )
    assert {"sh2", "sh3"}.isdisjoint(group["name"] for group in made.optimizer.param_groups)


def test_gaussians_removed_after_the_freeze_take_their_bands_along():
    made = tiny_trainer(densify="off", prune=False)
    raw = made.model.raw
    with torch.no_grad():
        raw["sh_logits"].copy_(torch.randn(raw["sh_logits"].shape) * 6)
        for band in (1, 2, 3):
            raw[f"sh{band}"].copy_(torch.randn(raw[f"sh{band}"].shape))
    made.population.freeze_bands(made.optimizer)
    before = made.finish()
    with torch.no_grad():
        raw["logit_opacities"][::3] = -20.0
    made.population.remove(made.optimizer, None)
    after = made.finish()
    kept = np.arange(len(before["means"])) % 3 != 0
    for name in ("means", "sh0", "shN", "degrees"):
        assert np.array_equal(after[name], before[name][kept]), name


def test_opacities_fall_as_often_as_asked_while_gaussians_grow_and_rise_between():
    made = tiny_trainer(
        steps=80, densify="off", prune=False, opacity_resets=3, densify_from=0.2, densify_until=0.6
    )
    fallen, highest = [], 0.0
    for _ in made.steps():
        opacities = made.model.raw["logit_opacities"]
        before, highest = highest, float(opacities.detach().sigmoid().max())
        if made.population.n_reset > len(fallen):
            fallen.append(made.step)
            assert before > 0.0102 and highest == pytest.approx(0.01)
            assert not made.optimizer.state[opacities]["exp_avg"].any()
            assert not made.optimizer.state[opacities]["exp_avg_sq"].any()
    assert fallen == [24, 32, 40] and highest > 0.012


def test_no_gaussian_reaches_past_the_cameras():
    made = tiny_trainer(steps=3, densify="off", prune=False)
    eyes = torch.linalg.inv(made.views.viewmats)[:, :3, 3]
    distance = (made.model.raw["means"].detach()[:, None] - eyes).norm(dim=-1).amin(1)
    assert torch.allclose(made.population.log_bound[:, 0].exp(), 0.33 * distance, rtol=1e-4)
    with torch.no_grad():
        made.model.raw["log_scales"][7] = torch.tensor([3.0, -4.0, -4.0])
        made.model.raw["log_scales"][8] = torch.nan
    made.population.bound_scales()
    scales = made.model.raw["log_scales"].detach()
    assert scales[7, 0] == made.population.log_bound[7, 0]
    assert torch.equal(scales[7, 1:], torch.tensor([-4.0, -4.0]))
    assert scales[8].isnan().all()  # found and counted where all that breaks is
    made.population.drop_broken(made.optimizer)
    made.refresh()
    for _ in made.steps():
        assert (made.model.raw["log_scales"].detach() <= made.population.log_bound + 1e-6).all()


def bits(made):
    parts = {f"raw {name}": value.detach() for name, value in made.model.raw.items()}
    for group in made.optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            state = made.optimizer.state[parameter]
            parts |= {f"{group['name']} {index} {key}": value for key, value in state.items()}
            parts[f"{group['name']} {index}"] = parameter.detach()
    return {name: value.clone() for name, value in parts.items()}


@pytest.mark.parametrize(
    "chosen",
    [{"densify": name} for name in ("mixed", "region", "classic")]
    + [{"densify": "classic", "opacity_resets": 3}],
    ids=lambda chosen: "-".join(map(str, chosen.values())),
)
def test_a_resumed_training_takes_the_same_steps_to_the_bit(tmp_path, chosen):
    """Saved after every step, through a file; over growth, removal, refreshes and the freeze."""
    settings = {"steps": 24, "refresh_every": 5, "grow_threshold": 1e-6} | chosen
    whole, sizes = tiny_trainer(**settings), []
    for _ in whole.steps():
        torch.save(whole.state_dict(), tmp_path / f"{whole.step}.pt")
        sizes.append(len(whole.model))
    assert len(set(sizes)) > 1 and "sh_logits" not in whole.model.raw
    wanted, parameters = bits(whole), whole.finish()
    for step in (1, 5, 9, 14, 16, 20, 23):
        resumed = tiny_trainer(**settings)
        resumed.load_state_dict(torch.load(tmp_path / f"{step}.pt", weights_only=True))
        assert resumed.step == step
        for _ in resumed.steps():
            pass
        found = bits(resumed)
        assert found.keys() == wanted.keys()
        assert not [
            name for name, value in wanted.items() if not torch.equal(found[name], value)
        ], step
        for name, value in resumed.finish().items():
            assert np.array_equal(value, parameters[name]), name


def test_a_picture_without_features_has_the_colours_of_one_with_them():
    made = tiny_trainer()
    pictures = [made.model.render(made.views.camera(0, 1), 3, semantic=k) for k in (True, False)]
    torch.testing.assert_close(pictures[1].rgb, pictures[0].rgb, rtol=0, atol=1e-6)
    assert pictures[0].features is not None and pictures[1].features is None


def test_growth_without_semantic_guidance_takes_the_same_steps_and_other_places():
    """The loss is split into two backward passes; their sum moves parameters as one does."""
    guided, alone = (tiny_trainer(steps=20, densify_from=0.8, densify_until=0.8) for _ in range(2))
    alone.grows_by_color = True
    for made in (guided, alone):
        with torch.no_grad():  # features of zero would not move geometry
            made.model.raw["features"].normal_(generator=torch.Generator().manual_seed(0))
        next(iter(made.steps()))
    assert not torch.equal(guided.population.gradient_sum, alone.population.gradient_sum)
    for name, value in guided.model.raw.items():
        torch.testing.assert_close(alone.model.raw[name], value, rtol=1e-4, atol=1e-6)


def test_a_budget_of_seconds_runs_the_whole_schedule():
    made = tiny_trainer(seconds=1.0, steps=10**6, refresh_every=5)
    for _ in made.steps():
        pass
    assert made.share == 1 and made.seconds >= 1
    assert 1 < made.step < 10**6 and made.population.n_grown >= 1
    assert made.schedule.last_step(made.step, made.seconds) == made.step


def test_gaussians_that_break_are_removed_and_counted():
    made = tiny_trainer(refresh_every=5)
    steps = made.steps()
    next(steps)
    with torch.no_grad():
        # the rasterizer leaves it out, so the loss stays finite
        made.model.raw["sh0"][7] = torch.nan
    for _ in steps:
        pass
    assert made.population.n_broken == 1
    assert all(np.isfinite(value).all() for value in made.finish().values())


def test_a_view_that_makes_the_loss_non_finite_is_named():
    made = tiny_trainer()
    made.views.features = lambda index: torch.full((10, 12, 8), torch.nan)
    with pytest.raises(
        DataFailure,
        match=r"step 1, view view\d: loss features is not finite; .* "
        r"look at the view",
    ):
        next(made.steps())


def looking_away(views):
    views.viewmats[1] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ views.viewmats[1]


def hidden(views):
    views.masks = torch.ones(views.images.shape[:3], dtype=torch.bool)
    views.masks[1] = False


@pytest.mark.parametrize("method", ["ours", "printed"])
@pytest.mark.parametrize("changes", [[looking_away], [hidden], [looking_away, hidden]])
def test_a_view_that_shows_nothing_stops_nothing(changes, method):
    views = four_views()
    for change in changes:
        change(views)
    made = tiny_trainer(views=views, method=method, prune_from=0.0)
    assert all(np.isfinite(list(figures.values())).all() for figures in made.steps())
    assert all(np.isfinite(values).all() for values in made.finish().values())
    counted = [0, 2, 3] if hidden in changes else [0, 1, 2, 3]
    assert made.held_in_psnr([0, 1, 2, 3]) == made.held_in_psnr(counted) < 100
    assert hidden not in changes or made.held_in_psnr([1]) == 0


def test_a_breakdown_is_named():
    made = tiny_trainer()
    with torch.no_grad():
        made.model.raw["features"][:] = torch.nan  # to remove them would leave none
    with pytest.raises(DataFailure, match=r"step \d+.*: .*not finite: .*features of \d+ Gaussians"):
        list(made.steps())


def test_weights_that_break_are_never_published():
    made = tiny_trainer(method="printed", steps=6)
    with torch.no_grad():
        made.model.printed.pruning.output.bias[0] = torch.inf
    with pytest.raises(DataFailure, match=r"not finite: printed.pruning.output.bias"):
        made.finish()


PRINT_BITS = """
import hashlib
from benchmarks.stability.training import tiny_trainer
made = tiny_trainer(refresh_every=5)
list(made.steps())
print(hashlib.sha256(b"".join(value.tobytes() for value in made.finish().values())).hexdigest())
"""


@pytest.mark.slow
def test_kernels_just_compiled_and_kernels_from_the_cache_give_the_same_bits(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PRINT_BITS]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True) for _ in range(2)
    )
    assert first.returncode == 0, first.stderr
    assert first.stdout == second.stdout


@pytest.mark.parametrize(
    ("settings", "rate"),
    [({"steps": 1000}, 1e-2), ({"steps": 50}, 5e-2), ({"steps": 1000, "lr_features": 3e-3}, 3e-3)],
)
def test_the_features_rate_fits_the_number_of_steps(settings, rate):
    made = tiny_trainer(lr_sh=0.0, **settings)
    groups = {group["name"]: group["rate"] for group in made.optimizer.param_groups}
    assert groups["sh"] == 0  # given, if nothing
    assert groups["features"] == pytest.approx(rate)


def decided(n_views=1, **train):
    """A train section of views of 320×240 pixels, resolved."""
    return resolved(TrainSection(**{"steps": 1000} | train), Evidence(n_views, n_views * 320 * 240))


def test_features_are_taught_in_one_step_of_so_many_unless_views_are_few():
    assert [decided(n).feature_every for n in (1, 10, 20, 40, 300)] == [1, 1, 2, 4, 4]
    assert decided(10, feature_every=7).feature_every == 7
    assert [decided(n).feature_start for n in (10, 39, 40)] == ["zero", "zero", "lifted"]
    assert decided(2, feature_start="lifted").feature_start == "lifted"
    assert rates(decided(40, feature_every=4))["features"] == pytest.approx(4e-2)
    made = tiny_trainer(steps=8, densify="off", prune=False, sh_prune=False, feature_every=3)
    steps, changed = made.steps(), []
    for _ in range(8):
        before = made.model.raw["features"].detach().clone()
        figures = next(steps)
        changed.append(not torch.equal(before, made.model.raw["features"].detach()))
        assert changed[-1] == ("loss_features" in figures)
    assert changed == [False, False, True, False, False, True, False, False]


def test_a_training_that_is_not_told_has_steps_by_the_pixels_of_its_photos():
    found = [decided(n_views, steps=None).steps for n_views in (1, 46, 47, 70, 100, 139, 140, 5000)]
    assert found == [1000, 1000, 1000, 1500, 2200, 3000, 3000, 3000]
    assert decided(5000, steps=7).steps == 7
    made = tiny_trainer(steps=None, n_densify=0)
    assert made.schedule.last_step(0, 0.0) == made.settings.steps == 1000
    told = tiny_trainer(steps=1000, n_densify=0)
    found = [[group["rate"] for group in one.optimizer.param_groups] for one in (made, told)]
    assert found[0] == found[1]


def test_gaussians_and_points_are_capped_by_the_pixels_of_the_training_photos():
    views = np.array([1, 520, 2084, 8334])
    for measured, least in ((True, 40_000), (False, 100_000)):
        found = [
            resolved(TrainSection(), Evidence(n, n * 320 * 240, measured)).max_gaussians
            for n in views.tolist()
        ]
        assert found == pytest.approx(least * np.array([1, 1, 2, 4]), rel=1e-3)
    assert decided(5000, max_gaussians=70).max_gaussians == 70
    is_test = np.arange(2605) % 5 == 0  # 2084 of them are trained on
    points = default_points(SimpleNamespace(is_test=is_test, size=(320, 240)))
    assert points == pytest.approx(0.9 * 80_000, rel=1e-3)
    assert default_points(SimpleNamespace(is_test=is_test[:9], size=(320, 240))) == 36_000


def test_rates_follow_the_number_of_steps_unless_they_are_given():
    published = rates(decided(steps=30_000))
    assert published["means"] == 1.6e-4 and published["sh0"] == 2.5e-3
    assert rates(decided(steps=100_000))["means"] == published["means"]
    short, default = rates(decided(steps=1000)), rates(decided(steps=3000))
    for name, factor in (
        ("means", 8),
        ("log_scales", 5.86),
        ("quats", 5.86),
        ("sh0", 4),
        ("sh3", 4),
    ):
        assert short[name] / published[name] == pytest.approx(factor, rel=0.02)
        assert published[name] < default[name] < short[name]
    assert rates(decided(steps=60))["means"] == short["means"]
    assert rates(decided(lr_means=1.6e-4))["means"] == 1.6e-4


def test_pruning_masks_go_no_farther_in_long_trainings_and_nothing_else_slows():
    def travel(name, steps):
        schedule = Schedule(decided(steps=steps))
        return sum(schedule.rate(name, step / steps, steps) for step in range(1, steps + 1))

    assert travel("prune_logits", 1500) == pytest.approx(travel("prune_logits", 3000) / 2, rel=1e-2)
    assert travel("prune_logits", 9000) == pytest.approx(travel("prune_logits", 3000), rel=1e-2)
    assert travel("sh_logits", 9000) == pytest.approx(3 * travel("sh_logits", 3000), rel=1e-2)
    timed = Schedule(decided(seconds=120.0))  # as many steps as the pace tells
    assert timed.rate("prune_logits", 0.5, timed.last_step(4000, 60.0)) == pytest.approx(
        3 / 8 * 0.1**0.5
    )


def test_photos_larger_than_a_step_takes_are_seen_reduced_then_in_windows(monkeypatch):
    made = tiny_trainer(steps=40, coarse_until=0.1, fine_from=0.5, densify="off")
    height, width = made.views.images.shape[1:3]
    monkeypatch.setattr(schedules, "STEP_SIDE", max(height, width) / 3)
    made.schedule = Schedule(made.settings, max(height, width))
    assert made.schedule.reduction == 3
    seen, render = [], made.model.render

    def noted(view, *arguments, **options):
        seen.append((view.height, view.width, view.K))
        return render(view, *arguments, **options)

    monkeypatch.setattr(made.model, "render", noted)
    for _ in made.steps():
        pass
    small, whole = (height // 6, width // 6), (height // 3, width // 3)
    assert [view[:2] for view in seen] == 4 * [small] + 36 * [whole]
    focal = [float(K[0, 0]) for _, _, K in seen]
    assert focal[19] == pytest.approx(focal[-2] / 3, rel=0.05)  # the last one teaches features
    assert len({tuple(K[:2, 2].tolist()) for _, _, K in seen[20:]}) > 9  # windows lie at random


def test_a_window_shows_its_part_of_the_picture():
    made = tiny_trainer(steps=4, densify="off")
    window = Window(3, 5, 11, 17)
    whole, part = (made.model.render(made.views.camera(1, 1, one), 3).rgb for one in (None, window))
    assert (
        part.shape[:2] == (11, 17) and (window.of(whole) - part).abs().max() < 0.01
    )  # large Gaussians beyond the border
    photo, _ = made.views.photo(1, window)
    assert torch.equal(photo, made.views.images[1][3:14, 5:22])


def test_a_photo_of_another_exposure_is_compared_in_it():
    """Photo 1 is what the model shows after a stop more light, cut off at white; photo 0, of the
    same exposure, is not.
    """
    made = tiny_trainer(steps=4, densify="off")
    with torch.no_grad():
        made.model.raw["sh0"] += 2
        shown = made.model.render(made.views.camera(1, 1), 0).rgb
        brighter = (exposed(shown, torch.ones(3)).clamp(0, 1) * 255).round().byte()
    assert (brighter == 255).any()
    made.views.images[1] = brighter
    alone = float(made.losses_of(1, 0.2)[1]["loss_color"])
    made.views.exposures = torch.ones(len(made.views.names), 3)
    together = [float(made.losses_of(view, 0.2)[1]["loss_color"]) for view in (0, 1)]
    assert together[1] < 0.005 < 0.03 < min(together[0], alone)
    assert made.held_in_psnr([1]) > 45 > made.held_in_psnr([0])


def test_a_training_ends_in_the_same_bits_on_any_number_of_threads():
    def compute():
        made = tiny_trainer(steps=30, weight_depth=1.0, depth_every=2)
        for _ in made.steps():
            pass
        return list(made.finish().values())

    before = torch.get_num_threads()
    torch.set_num_threads(1)  # as the stage does
    try:
        assert_same_bits(compute)
    finally:
        torch.set_num_threads(before)
