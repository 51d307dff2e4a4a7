"""The numba backend equals the plain-torch oracle, in value and gradient, and never depends on thread count."""

import sys
import types

import numba
import pytest
import torch

from chebsplat.rasterize import rasterize

NAMES = ("means", "quats", "scales", "opacities", "colors")


def scene(n=150, channels=5, seed=0):
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g) * torch.tensor([3.0, 2.0, 3.0]) - torch.tensor([1.5, 1.0, -1.0])
    quats, scales = torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.15 + 0.01
    return [means, quats, scales, torch.rand(n, generator=g) * 0.9 + 0.05, torch.rand(n, channels, generator=g)]


def camera(width=53, height=37, views=1):
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 3] = torch.arange(views) * 0.3
    K = torch.tensor([[45.0, 0, width / 2], [0, 42.0, height / 2], [0, 0, 1]]).repeat(views, 1, 1)
    return viewmats, K, width, height


def gradients(arguments, dtype, backend, weights, **options):
    arguments = [a.detach().to(dtype, copy=True).requires_grad_(True) for a in arguments]
    viewmats, K, width, height = camera(views=len(weights))
    render, alpha, meta = rasterize(
        *arguments, viewmats.to(dtype), K.to(dtype), width, height, backend=backend, **options
    )
    (render * weights.to(dtype)).sum().add((alpha * weights[..., :1].to(dtype)).sum()).backward()
    return render, alpha, [a.grad for a in arguments] + [meta["means2d"].grad], meta


@pytest.mark.parametrize("channels", [1, 3, 19])
@pytest.mark.parametrize("background", [False, True])
def test_cpu_equals_the_oracle_in_value_and_gradient(channels, background):
    weights = torch.randn(2, 37, 53, channels, generator=torch.Generator().manual_seed(1))
    backgrounds = torch.full((2, channels), 0.7) if background else None
    arguments = scene(channels=channels)
    a = gradients(arguments, torch.float32, "cpu", weights, backgrounds=backgrounds)
    exact = backgrounds.double() if background else None
    b = gradients(arguments, torch.float64, "reference", weights, backgrounds=exact)
    # float32 rounds alpha at the 1/255 cut differently from float64: isolated pixels may differ by one contribution
    for x, y in zip(a[:2], b[:2], strict=True):
        assert (x.double() - y).abs().quantile(0.999) < 2e-5
        assert (x.double() - y).abs().max() < 2 / 255
    for name, x, y in zip((*NAMES, "means2d"), a[2], b[2], strict=True):
        error = (x.double() - y).abs().flatten().sort().values
        assert error[int(0.99 * len(error))] < 2e-3 * y.abs().max(), name
        assert (x.double() - y).norm() < 2e-2 * y.norm(), name


def test_absolute_gradient_bounds_the_plain_one():
    weights = torch.randn(1, 37, 53, 3, generator=torch.Generator().manual_seed(1))
    *_, grads, meta = gradients(scene(channels=3), torch.float32, "cpu", weights)
    absolute = meta["means2d"].absgrad[0]
    assert (absolute >= grads[-1][0].abs() * (1 - 1e-4) - 1e-6).all()
    assert (absolute > 0).any()


def test_any_number_of_threads_gives_the_same_bits():
    weights = torch.randn(1, 37, 53, 4, generator=torch.Generator().manual_seed(2))
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, 2, min(4, before)):
            numba.set_num_threads(threads)
            render, alpha, grads, _ = gradients(scene(channels=4), torch.float32, "cpu", weights)
            results.append([render, alpha, *grads])
    finally:
        numba.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


def spoiled(case):
    arguments = scene(channels=3)
    means, quats, scales, opacities, colors = arguments
    if case == "nan mean":
        means[3, 1] = torch.nan
    elif case == "nan colour":
        colors[3, 1] = torch.nan
    elif case == "nan opacity":
        opacities[3] = torch.nan
    elif case == "zero quaternion":
        quats[3] = 0
    elif case == "long quaternion":
        quats[3] *= 1e20
    elif case == "huge scale":
        scales[3] = 1e15
    elif case == "needle":
        scales[3] = torch.tensor([1e3, 1e-9, 1e-9])
    elif case == "behind":
        means[:, 2] = -1
    elif case == "in the camera":
        means[3] = torch.tensor([0.0, 0.0, 0.011])
    return arguments


CASES = ["nan mean", "nan colour", "nan opacity", "zero quaternion", "long quaternion"]
CASES += ["huge scale", "needle", "behind", "in the camera"]


@pytest.mark.parametrize("case", CASES)
def test_extreme_gaussians_poison_nothing(case):
    weights = torch.ones(1, 37, 53, 3)
    render, alpha, grads, _ = gradients(spoiled(case), torch.float32, "cpu", weights)
    assert torch.isfinite(render).all()
    assert torch.isfinite(alpha).all()
    others = torch.arange(150) != 3
    for gradient in [*grads[:5], grads[5][0]]:
        assert torch.isfinite(gradient[others]).all()
    if case.startswith("nan") or case == "zero quaternion":
        without = [a.clone()[others] for a in scene(channels=3)]
        assert torch.equal(render, gradients(without, torch.float32, "cpu", weights)[0])


@pytest.mark.parametrize("n", [0, 1])
def test_no_or_one_gaussian_renders(n):
    arguments = [a[:n] for a in scene(channels=3)]
    weights = torch.ones(1, 37, 53, 3)
    render, _, grads, _ = gradients(arguments, torch.float32, "cpu", weights, backgrounds=torch.full((1, 3), 0.25))
    assert n == 1 or (render == 0.25).all()
    assert [len(g) for g in grads[:5]] == [n] * 5


def test_a_non_finite_image_gradient_is_an_error():
    weights = torch.ones(1, 37, 53, 3)
    weights[0, 3, 3, 0] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        gradients(scene(channels=3), torch.float32, "cpu", weights)


def test_float64_is_refused_by_the_cpu_backend_and_taken_by_auto():
    arguments = [a.double() for a in scene(channels=3)]
    viewmats, K, width, height = camera()
    with pytest.raises(ValueError, match="float32"):
        rasterize(*arguments, viewmats.double(), K.double(), width, height, backend="cpu")
    render, _, _ = rasterize(*arguments, viewmats.double(), K.double(), width, height)
    assert render.dtype == torch.float64


def test_a_gradient_to_a_camera_is_refused_not_dropped():
    viewmats, K, width, height = camera()
    with pytest.raises(ValueError, match="cameras no gradient"):
        rasterize(*scene(channels=3), viewmats.requires_grad_(True), K, width, height, backend="cpu")


def test_needle_has_the_gradient_of_float64():
    arguments = [a[:1] for a in scene(channels=3)]
    arguments[0] = torch.tensor([[0.05, 0.02, 1.5]])
    arguments[2] = torch.tensor([[1e3, 1e-9, 1e-9]])
    weights = torch.randn(1, 37, 53, 3, generator=torch.Generator().manual_seed(3))
    found = gradients(arguments, torch.float32, "cpu", weights)[2]
    exact = gradients(arguments, torch.float64, "reference", weights)[2]
    for name, x, y in zip(NAMES, found, exact, strict=False):
        error = (x.double() - y).abs().max() / y.abs().max()
        assert error < 1e-3, (name, error)


def test_cuda_backend_asks_gsplat_for_unpacked_absolute_gradients(monkeypatch):
    asked = {}

    def rasterization(*args, **options):
        asked.update(options)
        n = len(args[0])
        sizes = {"means2d": (1, n, 2), "radii": (1, n, 2), "depths": (1, n), "conics": (1, n, 3)}
        return torch.zeros(1), torch.zeros(1), {name: torch.zeros(size) for name, size in sizes.items()}

    class OnGpu(torch.Tensor):
        device = torch.device("cuda")

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    arguments = scene(channels=3)
    arguments[0] = arguments[0].as_subclass(OnGpu)
    meta = rasterize(*arguments, *camera(), max_alpha=0.999)[2]
    assert asked["packed"] is False and asked["absgrad"] is True and asked["sh_degree"] is None
    assert {name: meta[name].ndim for name in meta} == {"means2d": 3, "conics": 3, "depths": 2, "radii": 2}


def test_cuda_backend_refuses_tensors_on_the_cpu():
    with pytest.raises(ValueError, match="on a GPU"):
        rasterize(*scene(channels=3), *camera(), backend="cuda")
