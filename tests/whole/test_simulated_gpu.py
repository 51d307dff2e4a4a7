"""A training on a simulated GPU: nothing mixes devices, and a step moves no array of Gaussians."""

import chebsplat  # noqa: F401  # isort: skip
import json
import logging
import sys
from contextlib import nullcontext

import numpy as np
import pytest
import stand_in_gsplat
import torch
from raster import camera, gradients, scene
from simulated_gpu import GPU, SimulatedGpu

from benchmarks.training.cost import trainer_from
from chebsplat.rasterize import rasterize
from chebsplat.render import SceneRenderer
from chebsplat.stages import evaluate, train
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.runtime.command import Job
from chebsplat.training import losses
from chebsplat.training.trainer import READ_EVERY
from chebsplat.views import View

WHOLE = {
    "steps": 40, "densify_from": 0.1, "densify_until": 0.6, "prune_from": 0.2, "sh_freeze": 0.8,
    "refresh_every": 12, "remove_every": 6, "max_gaussians": 1200, "report_every": 20,
    "n_densify": 4,
    "grow_threshold": 1e-6, "coarse_until": 0.5,
}  # fmt: skip
REGIONS = {"n_regions": 24, "region_size": 8}


@pytest.fixture
def gpu(monkeypatch):
    """A simulated GPU, on which gsplat's stand-in renders; "cuda" is a device while
    `gpu.active()`.
    """
    simulated = SimulatedGpu()
    monkeypatch.setitem(sys.modules, "gsplat", stand_in_gsplat)
    monkeypatch.setattr(stand_in_gsplat, "within", [simulated.uncounted])
    losses._taps.cache_clear()  # of another device of this name
    yield simulated
    losses._taps.cache_clear()


@pytest.fixture
def trainer_on(up_to_teacher):
    """Makes a trainer of the toy scene before its first step, by device and settings."""

    def make(device, **settings):
        chosen = configs.build({"train": WHOLE | settings, "describe": REGIONS}, "toy")
        return trainer_from(
            up_to_teacher, chosen, "auto" if device == "cuda" else "reference", device=device
        )

    return make


def test_the_simulation_has_the_rules_of_torch(gpu):
    a = torch.arange(6.0)
    with gpu.active():
        b = a.to("cuda")
        assert (a.device.type, b.device, (b * 2 + a[0]).device) == ("cpu", GPU, GPU)
        assert (
            torch.zeros(3, device=b.device).device
            == b.new_zeros(2).device
            == b[b > 1].device
            == GPU
        )
        for mixed in (
            lambda: a + b,
            lambda: torch.stack([a[0], b[0]]),
            lambda: a.add_(b),
            lambda: b @ a,
        ):
            with pytest.raises(RuntimeError, match="mixes devices"):
                mixed()
        with pytest.raises(TypeError, match="copy it to the CPU"):
            b.numpy()
        leaf = torch.ones(6, device="cuda", requires_grad=True)
        (leaf * b).sum().backward()
        assert leaf.grad.device == GPU and torch.equal(leaf.grad.cpu(), a)
        gpu.moved.clear()
        assert float(b[1]) == 1 and b.nonzero().cpu().numpy().tolist() == [[1], [2], [3], [4], [5]]
        a.copy_(b)
        b[a.long()] = 0
    assert [(moved.kind, moved.shape) for moved in gpu.moved] == [
        ("down", ()), ("wait", (6,)), ("down", (5, 1)), ("down", (6,)), ("up", (6,)),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [
        {"densify": "mixed"},
        {"densify": "region", "feature_every": 1},
        {"densify": "classic"},
        {"semantics": False},
    ],
    ids=["defaults", "regions", "classic", "colour alone"],
)
def test_growth_pruning_refresh_freeze_and_finish_mix_no_devices(settings, gpu, trainer_on):
    with gpu.active():
        made = trainer_on("cuda", **settings)
        n = len(made.model)
        for _ in made.steps():
            pass
        assert made.population.n_added > 0 and "sh_logits" not in made.model.raw
        assert {value.device for value in made.model.raw.values()} == {GPU}
        parameters = made.finish()
    assert all(
        isinstance(value, np.ndarray) and np.isfinite(value).all() for value in parameters.values()
    )
    assert len(parameters["means"]) != n


def test_a_step_moves_no_array_of_gaussians_and_reads_figures_every_tenth_time(gpu, trainer_on):
    settings = {
        "densify": "off",
        "refresh_every": 1000,
        "remove_every": 1000,
        "report_every": 1000,
        "sh_freeze": 1.0,
    }
    largest, n_read = 0, 0
    with gpu.active():
        made = trainer_on("cuda", **settings)
        gpu.moved.clear()
        for _ in made.steps():
            # that is the stand-in's
            moved = [one for one in gpu.moved if "_refuse_broken" not in one.what]
            gpu.moved.clear()
            frozen = made.step == WHOLE["steps"]
            if frozen:
                continue
            down = [one for one in moved if one.kind == "down"]
            assert [len(one.shape) for one in down] == (
                [1] if made.step % READ_EVERY == 0 else []
            ), down
            n_read += len(down) > 0
            assert not [one for one in moved if one.kind == "wait"]
            up = [one.shape for one in moved if one.kind == "up"]
            assert not [shape for shape in up if len(made.model) in shape]
            largest = max([largest, *(int(np.prod(shape)) for shape in up)])
        views = made.views  # no more than what the teacher says of a view, or its measured depth
        assert largest == max(views.features(0).numel(), views.depth(0, 1).numel())
    assert n_read == WHOLE["steps"] // READ_EVERY - 1


def test_a_step_launches_at_most_60_operations_beside_those_of_gsplat(gpu, trainer_on):
    settings = {
        "densify": "off",
        "refresh_every": 1000,
        "remove_every": 1000,
        "report_every": 1000,
        "sh_freeze": 1.0,
    }
    counts = {}
    with gpu.active():
        made = trainer_on("cuda", **settings)
        for _ in made.steps():
            recorded = [
                recording.graph is not None for recording in made.model.replay.recordings.values()
            ]
            counts[made.step] = gpu.launches, (len(recorded), sum(recorded))
            gpu.launches = 0
    assert made.model.raw["features"].shape[1] >= 3 and "sh_logits" in made.model.raw
    replayed = [
        n for step, (n, recorded) in counts.items() if recorded == counts.get(step - 1, (0, 0))[1]
    ]
    assert len(replayed) > WHOLE["steps"] / 2 and 10 < max(replayed) <= 60, counts


def test_a_step_that_cannot_be_recorded_is_launched_as_it_is(gpu, trainer_on, caplog):
    def refuse(function, samples, warm_ups, allow_unused_input):
        raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nand more")

    gpu.graphed = refuse
    with gpu.active():
        made = trainer_on("cuda", densify="off")
        for _ in made.steps():
            pass
        assert np.isfinite(made.finish()["means"]).all()
    (said,) = [record.message for record in caplog.records if "CUDA graph" in record.message]
    assert said.endswith("capturing")


@pytest.mark.parametrize("stops", [None, 0.3])
def test_a_training_on_the_simulated_gpu_is_the_one_in_plain_torch(gpu, trainer_on, stops):
    """Photos have one exposure, or each its own."""
    exposures = None if stops is None else torch.linspace(-stops, stops, 300).reshape(100, 3)
    plain = trainer_on("cpu", densify="off")
    plain.views.exposures = exposures
    for _ in plain.steps():
        pass
    with gpu.active():
        made = trainer_on("cuda", densify="off")
        made.views.exposures = None if exposures is None else exposures.to("cuda")
        for _ in made.steps():
            pass
        found = made.held_in_psnr([0, 1, 2])
    assert found == pytest.approx(plain.held_in_psnr([0, 1, 2]), abs=0.01)  # dB


def test_the_stage_trains_there(gpu, up_to_teacher, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    folders = (("capture", "ingest"), ("points", "sfm"), ("features", "teacher"))
    inputs = {role: up_to_teacher / of for role, of in folders}
    sections = {"train": WHOLE, "describe": REGIONS}
    (tmp_path / "out").mkdir()
    job = Job(
        inputs, configs.build(sections, "toy"), tmp_path / "out", tmp_path / "scratch", "cuda"
    )
    with gpu.active():
        train.run(job)
    assert "peak_device_bytes" in job.facts and job.facts["steps"] == 40


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("channels", [1, 3, 16, 19, 35])
def test_the_cuda_backend_renders_as_the_others_through_what_gsplat_is_asked(channels, mode, gpu):
    arguments, options = scene(channels=channels), {"rasterize_mode": mode, "absgrad": True}
    backgrounds = torch.full((2, channels), 0.7)
    weights = torch.randn(2, 37, 53, channels, generator=torch.Generator().manual_seed(1))
    wanted = gradients(
        arguments, torch.float32, "reference", weights, backgrounds=backgrounds, **options
    )
    with gpu.active():
        there = backgrounds.to("cuda")
        found = gradients(
            arguments, torch.float32, "auto", weights, device="cuda", backgrounds=there, **options
        )
        images = [value.cpu() for value in found[:2]]
        slopes = [value.cpu() for value in [*found[2], found[3]["means2d"].absgrad]]
        assert found[3]["radii"].shape == (2, 150)
    for a, b in zip(
        [*images, *slopes], [*wanted[:2], *wanted[2], wanted[3]["means2d"].absgrad], strict=True
    ):
        # the same operations, but on quaternions of another length
        assert (a - b).norm() <= 1e-6 * b.norm()


def test_an_opacity_above_the_ceiling_is_as_opaque_in_the_middle_and_keeps_its_gradient(gpu):
    means, quats = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0, 0, 0]])
    arguments = [means, quats, torch.full((1, 3), 0.3), torch.tensor([0.999]), torch.ones(1, 1)]
    viewmats, Ks, width, height = camera()
    alphas = []
    for backend, device in (("reference", "cpu"), ("auto", "cuda")):
        with gpu.active():
            given = [value.to(device, copy=True).requires_grad_() for value in arguments]
            alpha = rasterize(
                *given, viewmats.to(device), Ks.to(device), width, height, backend=backend
            )[1]
            alpha.sum().backward()
            assert given[3].grad.item() > 0
            alphas.append(alpha.detach().cpu()[0, ..., 0])
    assert alphas[0].max() == pytest.approx(0.99) and (alphas[0] - alphas[1]).abs().max() < 0.0101
    middle = height // 2, width // 2
    assert alphas[1][middle] == pytest.approx(alphas[0][middle].item(), abs=1e-3)


def test_a_ceiling_that_gsplat_cannot_keep_is_refused(gpu):
    with gpu.active():
        there = [value.to("cuda") for value in scene(channels=3)]
        viewmats, Ks, *size = camera()
        with pytest.raises(ValueError, match=r"keeps none above 0.999"):
            rasterize(*there, viewmats.to("cuda"), Ks.to("cuda"), *size, max_alpha=1.0)


def test_a_finished_scene_renders_there_as_on_the_cpu(gpu):
    rng = np.random.default_rng(0)
    means, quats, scales, opacities, _ = (value.numpy() for value in scene())
    parameters = {"means": means, "quats": quats, "log_scales": np.log(scales)}
    parameters["logit_opacities"] = np.zeros_like(opacities)
    parameters |= {
        "sh0": rng.normal(size=(150, 1, 3)).astype(np.float32),
        "features": np.ones((150, 4), np.float32),
    }
    # nothing is above a degree
    degrees, band = np.sort(rng.integers(0, 4, 150)), np.repeat([1, 2, 3], [3, 5, 7])
    shN = rng.normal(size=(150, 15, 3)) * (band <= degrees[:, None])[..., None]
    parameters |= {"shN": shN.astype(np.float32), "degrees": degrees}
    viewmats, Ks, width, height = camera()
    view = View(Ks[0], viewmats[0], width, height)
    wanted, depth = (
        SceneRenderer(parameters).render(view, True),
        SceneRenderer(parameters).render_depth(view),
    )
    with gpu.active():
        empty = SceneRenderer({name: values[:0] for name, values in parameters.items()}, "cuda")
        assert not empty.render(view)[0].any()
        renderer = SceneRenderer(parameters, "cuda")
        found, there = renderer.render(view, True), renderer.render_depth(view)
    assert np.abs(found[0].astype(int) - wanted[0]).max() <= 1  # grey levels
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-5)
    np.testing.assert_allclose(there[0], depth[0], rtol=1e-5)  # its quaternions were scaled


@pytest.mark.xdist_group("toy")
def test_a_scene_is_evaluated_there_as_on_the_cpu(gpu, toy, tmp_path):
    inputs = {"capture": toy["ingest"], "scene": toy["export"], "features": toy["teacher"]}
    config = configs.build({"evaluate": {"timing_repeats": 1}}, "toy")
    made = {}
    for device in ("cpu", "cuda"):
        (out := tmp_path / device).mkdir()
        job = Job(inputs, config, out, tmp_path / "scratch", device)
        with gpu.active() if device == "cuda" else nullcontext():
            evaluate.run(job)
        made[device] = json.loads((out / "figures.json").read_text())
    found, wanted = made["cuda"], made["cpu"]
    assert found["image"]["psnr"] == pytest.approx(wanted["image"]["psnr"], abs=1e-3)
    assert found["segmentation"]["scene"]["miou"] == pytest.approx(
        wanted["segmentation"]["scene"]["miou"], abs=1e-3
    )
    assert (
        found["frames_per_second"]
        and "by part" in str(found["left_out"])
        and not found["milliseconds"]
    )


def test_plain_torch_on_a_gpu_renders_each_view_anew(gpu, trainer_on, up_to_teacher):
    chosen = configs.build({"train": WHOLE | {"densify": "off"}, "describe": REGIONS}, "toy")
    plain = trainer_on("cpu", densify="off")
    with gpu.active():
        made = trainer_from(up_to_teacher, chosen, "reference", device="cuda")
        for index in (0, 0, 5, 9):
            views = made.views.camera(index, 1), plain.views.camera(index, 1)
            found, wanted = (
                one.model.render(view, 0).rgb
                for one, view in zip((made, plain), views, strict=True)
            )
            torch.testing.assert_close(found.detach().cpu(), wanted.detach())
