"""The cuda backend asks gsplat for what the others do, says what is missing, and renders as they
do.
"""

import sys
import types

import pytest
import torch
from raster import NAMES, camera, gradients, scene, undecided

from chebsplat.rasterize import rasterize
from tests.chebsplat.rasterize.test_rasterize import tiny_case
from tests.chebsplat.rasterize.test_rasterize_exact import EXTREMES

CEILING = 0.999  # gsplat's


class OnGpu(torch.Tensor):
    device = torch.device("cuda")


@pytest.fixture
def asked(monkeypatch):
    """What a stand-in for gsplat is called with."""
    asked = {}

    def rasterization(*args, **options):
        asked.update(options, gaussians=args[:5])
        n, (width, height) = len(args[0]), args[7:9]
        found = {"means2d": (1, n, 2), "radii": (1, n, 2), "depths": (1, n), "conics": (1, n, 3)}
        image = torch.zeros(1, height, width, args[4].shape[-1])
        return image, image[..., :1], {name: torch.ones(size) for name, size in found.items()}

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    return asked


def render(arguments, **options):
    return rasterize(
        arguments[0].as_subclass(OnGpu), *arguments[1:], *camera(), max_alpha=CEILING, **options
    )


def test_gsplat_takes_cell_colors_as_channels_on_black(asked):
    image, _, meta = render(
        scene(channels=3), backgrounds=torch.ones(1, 3), cell_colors=torch.rand(150, 5)
    )
    assert asked["channel_chunk"] >= 8 and asked["backgrounds"].tolist() == [[1.0] * 3 + [0.0] * 5]
    assert image.shape[-1] == 3 and meta["cells"].shape == (1, 10, 14, 5)


def test_more_channels_than_gsplat_has_are_refused(asked):
    with pytest.raises(ValueError, match="512 channels"):
        render(scene(channels=513))


@pytest.mark.parametrize("field", range(5), ids=NAMES)
def test_gsplat_never_sees_a_broken_gaussian(field, asked):
    arguments = scene(channels=3)
    arguments[field][3] = torch.nan
    render(arguments)
    means, quats, scales, opacities, colors = (torch.Tensor(a) for a in asked["gaussians"])
    assert all(torch.isfinite(a).all() for a in (means, quats, scales, opacities, colors))
    assert opacities[3] == 0 and (opacities > 0).sum() == 149
    others = torch.arange(150) != 3
    assert torch.equal(means[others], arguments[0][others]) and torch.equal(
        colors[others], arguments[4][others]
    )


def test_long_quaternions_do_not_overflow(asked):
    arguments = scene(channels=3)
    arguments[1] *= 1e20
    render(arguments)
    assert asked["gaussians"][1].norm(dim=-1).max() <= 2


def test_a_missing_gsplat_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"make setup device=cuda.*backend='reference'"):
        render(scene(channels=3))


def test_tensors_on_the_cpu_are_refused():
    with pytest.raises(ValueError, match="on a GPU"):
        rasterize(*scene(channels=3), *camera(), backend="cuda")


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("channels", [1, 3, 19, 32, 35])
@pytest.mark.parametrize("background", [False, True], ids=["black", "background"])
def test_random_scenes_are_as_on_the_cpu(channels, mode, background):
    options = {"rasterize_mode": mode, "max_alpha": CEILING, "absgrad": True}
    arguments = scene(channels=channels)
    backgrounds = torch.full((2, channels), 0.7) if background else None
    weights = torch.randn(2, 37, 53, channels, generator=torch.Generator().manual_seed(1))
    weights[undecided(arguments, 53, 37, 2, rasterize_mode=mode, max_alpha=CEILING)] = 0
    a = gradients(arguments, torch.float32, "cpu", weights, backgrounds=backgrounds, **options)
    on_gpu = backgrounds.cuda() if background else None
    b = gradients(
        arguments, torch.float32, "cuda", weights, device="cuda", backgrounds=on_gpu, **options
    )
    decided = (weights != 0).all(-1)
    # gsplat's exponential is approximate (2 units in the last place at best), and its covariance
    # float32 throughout
    for x, y in zip(a[:2], b[:2], strict=True):
        assert (x - y.cpu())[decided].abs().max() < 1e-4
    for name, x, y in zip((*NAMES, "means2d"), a[2], b[2], strict=True):
        assert (x - y.cpu()).norm() < 1e-3 * x.norm(), name
    absolute = [m["means2d"].absgrad.cpu() for m in (a[3], b[3])]
    assert (absolute[0] - absolute[1]).norm() < 1e-3 * absolute[0].norm()
    # gsplat's box is the tighter one
    assert ((a[3]["radii"] > 0) | (b[3]["radii"].cpu() == 0)).all()


@pytest.mark.gpu
@pytest.mark.data
def test_reference_image_of_four_gaussians_is_as_on_the_cpu():
    arguments, image = tiny_case()
    on_gpu = [a.cuda() if isinstance(a, torch.Tensor) else a for a in arguments]
    found = rasterize(*on_gpu, max_alpha=CEILING, backend="cuda")
    expected = rasterize(*arguments, max_alpha=CEILING, backend="cpu")
    both = [torch.cat([render, alpha], -1)[0].cpu() for render, alpha, _ in (found, expected)]
    assert (both[0] - both[1]).abs().max() < 1e-4
    assert (both[0] - image).abs().max() < 1e-4


@pytest.mark.gpu
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_input_renders_as_on_the_cpu(name, mode):
    options = {"rasterize_mode": mode, "max_alpha": CEILING}
    arguments = scene(channels=3)
    arguments[0][3] = torch.tensor([0.05, 0.02, 1.5])
    EXTREMES[name][0](arguments)
    weights = torch.ones(1, 37, 53, 3)
    weights[undecided(arguments, 53, 37, **options)] = 0
    decided = (weights != 0).all(-1)
    a = gradients(arguments, torch.float32, "cpu", weights, **options)
    b = gradients(arguments, torch.float32, "cuda", weights, device="cuda", **options)
    if name != "needle":  # float32 covariances have lost its width
        for x, y in zip(a[:2], b[:2], strict=True):
            assert (x - y.cpu())[decided].abs().max() < 1e-3
    assert all(torch.isfinite(image).all() for image in b[:2])
    assert all(torch.isfinite(g).all() for g in b[2])


@pytest.mark.gpu
@pytest.mark.parametrize("n", [0, 5])
def test_nothing_in_view_is_the_background(n):
    arguments = [a[:n] for a in scene(channels=3)]
    arguments[0][:, 2] = -1
    backgrounds = torch.tensor([[0.1, 0.2, 0.3]], device="cuda")
    weights = torch.ones(1, 37, 53, 3)
    options = {"device": "cuda", "max_alpha": CEILING, "backgrounds": backgrounds, "absgrad": True}
    image, alpha, grads, meta = gradients(arguments, torch.float32, "cuda", weights, **options)
    assert (image == backgrounds).all() and (alpha == 0).all()
    assert all((g == 0).all() for g in [*grads, meta["means2d"].absgrad])
