"""A training in plain torch, which is what a GPU takes, is the training of the compiled kernels."""

import chebsplat  # noqa: F401  # isort: skip
import pytest
import torch

from benchmarks.training.cost import trainer_from
from chebsplat.stages.runtime import config as configs
from chebsplat.training.losses import feature_distance

STEPS = 200
# what a pair at the limit of 1/255 may change, where rounding decides whether it is drawn
LIMIT = 2 / 255


@pytest.fixture
def trainer_of(up_to_teacher):
    """Makes a trainer of the toy scene before its first step, by backend and settings."""

    def make(backend, **train):
        return trainer_from(
            up_to_teacher, configs.build({"train": {"steps": STEPS} | train}, "toy"), backend
        )

    return make


@pytest.fixture
def no_kernels(monkeypatch):
    """Fails where a compiled kernel is called."""

    def refuse(*_):
        raise AssertionError("a compiled kernel was called")

    def forbid():
        from chebsplat.rasterize import cpu
        from chebsplat.splats import sh_kernels
        from chebsplat.training import loss_kernels

        monkeypatch.setattr(cpu, "rasterize", refuse)
        monkeypatch.setattr(sh_kernels, "colors_in_view", refuse)
        monkeypatch.setattr(loss_kernels, "feature_distance", refuse)
        monkeypatch.setattr(loss_kernels, "photometric", refuse)

    return forbid


def gradients(trainer):
    return {name: leaf.grad for name, leaf in trainer.model.raw.items() if leaf.grad is not None}


@pytest.mark.slow
def test_two_hundred_steps_in_plain_torch_reach_the_same_psnr(trainer_of, no_kernels):
    # Without growth: which Gaussians grow is decided by comparisons, and what rounding decides
    # there is worth 0.1 dB.
    settings = {"densify": "off"}
    compiled, plain = trainer_of("auto", **settings), trainer_of("reference", **settings)
    for _ in compiled.steps():
        pass
    every = list(range(len(compiled.views.names)))
    wanted, finished = compiled.held_in_psnr(every), compiled.finish()
    no_kernels()
    for _ in plain.steps():
        pass
    assert abs(plain.held_in_psnr(every) - wanted) < 0.01
    assert plain.finish().keys() == finished.keys()


@pytest.mark.parametrize("after", [1, 26], ids=["at the start", "with masks and bands"])
def test_gradients_of_a_step_in_plain_torch_are_those_of_the_kernels(after, trainer_of):
    settings = {"densify": "off", "prune_from": 0.1, "feature_every": 1}
    compiled, plain = (
        trainer_of(backend, steps=40, **settings) for backend in ("auto", "reference")
    )
    steps = compiled.steps()
    for _ in range(after):
        next(steps)
    farthest = []
    # one step in ten has a pair whose drawing rounding decides, which those behind it feel
    for _ in range(3):
        plain.load_state_dict(torch.load(_saved(compiled), weights_only=True))
        figures = next(steps), next(plain.steps())
        assert figures[0].keys() == figures[1].keys()
        for name, value in figures[0].items():
            assert figures[1][name] == pytest.approx(value, rel=1e-5), name
        found, wanted = gradients(plain), gradients(compiled)
        assert found.keys() == wanted.keys()
        if after > 1:
            assert {
                "sh1",
                "sh_logits",
                "prune_logits",
            } <= wanted.keys()
            assert wanted["sh1"].any() and wanted["sh_logits"].any()
        off = {}
        for name, expected in wanted.items():
            if not expected.any():  # a band that no Gaussian has kept
                assert not found[name].any(), name
                continue
            off[name] = float((found[name] - expected).abs().max() / expected.abs().max())
        farthest.append(max(off.values()))
        assert farthest[-1] < LIMIT, max(off, key=off.__getitem__)
    assert min(farthest) < 1e-4


def _saved(trainer):
    import io

    file = io.BytesIO()
    torch.save(trainer.state_dict(), file)
    file.seek(0)
    return file


@pytest.mark.parametrize("kind", ["length", "l1"])
def test_cells_that_do_not_count_may_be_anything_in_plain_torch_too(kind):
    render = torch.rand(8, 8, 3, requires_grad=True)
    target, counted = torch.rand(4, 4, 3), torch.ones(4, 4, dtype=torch.bool)
    target[1, 2], counted[1, 2] = torch.nan, False
    found = [
        feature_distance(render, target, None, kind, counted, backend)
        for backend in ("auto", "reference")
    ]
    assert found[0].item() == pytest.approx(found[1].item(), rel=1e-6)
    (gradient,) = torch.autograd.grad(found[1], render)
    assert torch.isfinite(gradient).all() and (gradient[2:4, 4:6] == 0).all()


def test_an_unknown_backend_is_refused():
    with pytest.raises(ValueError, match="none of auto, cpu, cuda, reference"):
        feature_distance(torch.rand(8, 8, 3), torch.rand(4, 4, 3), backend="gpu")
