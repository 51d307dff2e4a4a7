"""Every backend equals float64, in value and gradient: channel counts, ragged edges, modes, extreme
inputs.

Pixels where float32 may round an alpha across a limit (1/255, the ceiling, the stop) are left out:
there a whole contribution comes or goes, whoever is right. They are found in float64, and few.
"""

import pytest
import torch
from raster import NAMES, brute_force, camera, gradients, scene, undecided

from chebsplat.rasterize import rasterize

IMAGE = 1e-6  # at worst, of values in [0, 1]
# the same under a pixel: a mean at 50 is rounded by up to 2e-6, and alpha changes by 0.9 a pixel
MEANS = 2e-6
GRADIENT = 1e-4  # relative, of each tensor's norm and of its largest entry
ORACLE = 1e-10


@pytest.fixture(autouse=True)
def one_torch_thread():
    """The images are small: more threads only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def assert_agree(found, exact, decided, image, gradient):
    for x, y in zip(found[:2], exact[:2], strict=True):
        error = (x.double() - y)[decided]
        assert error.numel() == 0 or error.abs().max() <= image
    for name, x, y in zip((*NAMES, "means2d"), found[2], exact[2], strict=True):
        assert torch.isfinite(x).all(), name
        error = x.double() - y
        assert error.norm() <= gradient * y.norm(), (name, error.norm() / y.norm())
        assert y.numel() == 0 or error.abs().max() <= gradient * y.abs().max(), name


def loss_weights(arguments, width, height, views=1, **options):
    """Random [C, H, W, D], 0 where undecided; and which pixels are decided."""
    doubtful = undecided(arguments, width, height, views, **options)
    assert doubtful.float().mean() < 0.02
    g = torch.Generator().manual_seed(1)
    weights = torch.randn(views, height, width, arguments[4].shape[-1], generator=g)
    weights[doubtful] = 0
    return weights, ~doubtful


def check(arguments, width=53, height=37, views=1, backend="cpu", image=IMAGE, **options):
    weights, decided = loss_weights(arguments, width, height, views, **options)
    exact = brute_force(arguments, weights, **options)
    oracle = gradients(arguments, torch.float64, "reference", weights, **options)
    assert_agree(oracle, exact, decided, ORACLE, ORACLE)
    if backend != "reference":
        found = gradients(arguments, torch.float32, backend, weights, **options)
        assert_agree(found, oracle, decided, image, GRADIENT)
        return found
    return oracle


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7, 8, 13, 16, 19, 24, 31, 32, 35])
@pytest.mark.parametrize("size", [(37, 23), (16, 16), (17, 1)], ids=["37x23", "16x16", "17x1"])
def test_any_channels_and_edges_are_exact(channels, size):
    check(scene(channels=channels), *size)


@pytest.mark.parametrize("n", [1, 5, 16, 33])
@pytest.mark.parametrize(
    "size", [(53, 37), (32, 16), (17, 1), (3, 2)], ids=lambda size: f"{size[0]}x{size[1]}"
)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_cell_colors_are_means_over_cells_of_what_colors_would_be(backend, size, n):
    arguments, generator = scene(channels=3), torch.Generator().manual_seed(1)
    arguments.append(torch.rand(150, n, generator=generator))
    viewmats, K, width, height = camera(*size)
    corners = [(y, x) for y in range(0, height, 4) for x in range(0, width, 4)]
    doubtful = undecided([*arguments[:4], torch.cat(arguments[4:], 1)], width, height)[0]
    decided = torch.stack([~doubtful[y : y + 4, x : x + 4].any() for y, x in corners])
    assert decided.double().mean() > 0.7
    weights = torch.randn(height, width, 3, generator=generator).masked_fill(doubtful[..., None], 0)
    of_means = torch.randn(len(corners), n, generator=generator) * decided[:, None]

    def differentiated(dtype, render):
        leaves = [a.to(dtype, copy=True).requires_grad_(True) for a in arguments]
        image, means = render(leaves, viewmats.to(dtype), K.to(dtype), width, height)
        ((image * weights).sum() + (means * of_means).sum()).backward()
        return image.detach()[~doubtful], means.detach()[decided], [a.grad for a in leaves]

    def by_pixel(leaves, *camera):
        image = rasterize(*leaves[:4], torch.cat(leaves[4:], 1), *camera, backend="reference")[0][0]
        return image[..., :3], torch.stack(
            [image[y : y + 4, x : x + 4, 3:].mean((0, 1)) for y, x in corners]
        )

    def by_cell(leaves, *camera):
        image, _, meta = rasterize(*leaves[:5], *camera, backend=backend, cell_colors=leaves[5])
        return image[0], meta["cells"].flatten(0, 2)

    exact = differentiated(torch.float64, by_pixel)
    found = differentiated(torch.float32 if backend == "cpu" else torch.float64, by_cell)
    for x, y in zip(found[:2], exact[:2], strict=True):
        assert (x.double() - y).abs().max() <= IMAGE
    for name, x, y in zip((*NAMES, "cell_colors"), found[2], exact[2], strict=True):
        assert (x.double() - y).norm() <= GRADIENT * y.norm(), name


def test_a_gaussian_with_a_broken_cell_color_is_not_drawn():
    arguments, generator = scene(channels=3), torch.Generator().manual_seed(1)
    in_cells = torch.rand(150, 4, generator=generator)
    in_cells[7, 2] = torch.nan
    gone = [torch.cat([a[:7], a[8:]]) for a in (*arguments, in_cells)]
    viewmats, K, width, height = camera()
    for backend in ("reference", "cpu"):
        broken = rasterize(
            *arguments, viewmats, K, width, height, backend=backend, cell_colors=in_cells
        )
        without = rasterize(
            *gone[:5], viewmats, K, width, height, backend=backend, cell_colors=gone[5]
        )
        torch.testing.assert_close(broken[0], without[0])
        torch.testing.assert_close(broken[2]["cells"], without[2]["cells"])


def test_a_non_finite_gradient_of_the_cells_is_an_error():
    arguments = [a.requires_grad_(True) for a in scene(channels=3)]
    viewmats, K, width, height = camera()
    _, _, meta = rasterize(
        *arguments, viewmats, K, width, height, backend="cpu", cell_colors=arguments[4].detach()
    )
    with pytest.raises(ValueError, match="view 0 is not finite"):
        (meta["cells"] * torch.inf).sum().backward()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(
    "size", [0.02, 0.2, 1.0], ids=["less than a pixel", "about a pixel", "pixels"]
)
def test_each_mode_is_exact_at_any_size_of_gaussians(mode, size):
    arguments = scene(channels=3)
    arguments[2] *= size
    check(arguments, rasterize_mode=mode, image=IMAGE if size == 1 else MEANS)


def test_several_views_and_backgrounds_are_exact():
    check(scene(channels=4), views=2)
    arguments = scene(channels=4)
    weights, decided = loss_weights(arguments, 37, 23, 2)
    background = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.9, 0.8, 0.7, 0.6]])
    found = gradients(arguments, torch.float32, "cpu", weights, backgrounds=background)
    oracle = gradients(
        arguments, torch.float64, "reference", weights, backgrounds=background.double()
    )
    assert_agree(found, oracle, decided, IMAGE, GRADIENT)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_several_views_in_one_call_equal_separate_calls(backend):
    arguments, dtype = scene(channels=3), torch.float64 if backend == "reference" else torch.float32
    arguments = [a.to(dtype).requires_grad_(True) for a in arguments]
    viewmats, K, width, height = camera(views=3)
    options = {"width": width, "height": height, "backend": backend}
    viewmats, K = viewmats.to(dtype), K.to(dtype)
    colors = arguments[4].detach() * torch.tensor([1.0, 0.5, 0.25], dtype=dtype)[:, None, None]
    together = rasterize(*arguments[:4], colors, viewmats, K, **options)
    together[0].square().sum().backward()
    gradient = [a.grad.clone() for a in arguments[:4]]
    for a in arguments:
        a.grad = None
    for c in range(3):
        alone = rasterize(*arguments[:4], colors[c], viewmats[c : c + 1], K[c : c + 1], **options)
        assert torch.equal(alone[0][0], together[0][c]) and torch.equal(alone[1][0], together[1][c])
        assert torch.equal(alone[2]["radii"][0], together[2]["radii"][c])
        alone[0].square().sum().backward()
    for name, a, found in zip(NAMES, arguments[:4], gradient, strict=False):
        torch.testing.assert_close(
            found, a.grad, rtol=1e-4, atol=1e-6 * float(a.grad.abs().max()), msg=name
        )


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_absolute_gradient_is_the_sum_over_pixels(mode):
    arguments = scene(40, channels=2)
    weights, _ = loss_weights(arguments, 17, 6, rasterize_mode=mode)
    expected = torch.zeros(1, 40, 2, dtype=torch.float64)
    for y in range(6):
        for x in range(17):
            one = torch.zeros_like(weights)
            one[0, y, x] = weights[0, y, x]
            expected += gradients(arguments, torch.float64, "reference", one, rasterize_mode=mode)[
                2
            ][5].abs()
    for backend, dtype, error in (
        ("reference", torch.float64, ORACLE),
        ("cpu", torch.float32, GRADIENT),
    ):
        *_, meta = gradients(arguments, dtype, backend, weights, rasterize_mode=mode, absgrad=True)
        assert (meta["means2d"].absgrad - expected).abs().max() <= error * expected.max()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_gaussian_outside_reaches_in_as_far_as_it_shows(backend):
    # its mean is 3.1 to 3.3 σ beyond the middle of the last pixels, and a wider image of the same
    # camera cannot cull it
    K = torch.tensor([[[160.0, 0, 200], [0, 160, 10], [0, 0, 1]]])
    arguments = [
        torch.tensor([[0.0, 0, 2]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.1),
    ]
    arguments += [torch.tensor([0.99]), torch.ones(1, 1)]
    for reach in (3.1, 3.2, 3.3):
        slope = 1.5
        for _ in range(50):
            sigma = (64 * (1 + slope**2) + 0.3) ** 0.5
            slope = (399.5 + reach * sigma - 200) / 160
        arguments[0][0, 0] = 2 * slope
        narrow, wide = (
            rasterize(*arguments, torch.eye(4)[None], K, width, 20, backend=backend)[0]
            for width in (400, 600)
        )
        assert narrow.max() > 1 / 255
        torch.testing.assert_close(narrow, wide[:, :, :400], rtol=1e-4, atol=1e-6)


# Extreme inputs: Gaussian 3 is spoiled; `culled` says that it must then be as if it were not there.


def put(field, value, culled=False):
    def spoil(arguments):
        arguments[NAMES.index(field)][3] = torch.as_tensor(value)

    return spoil, culled


def pile(arguments):
    """Eight nearly opaque layers before the camera: compositing stops within."""
    arguments[0][:8] = torch.tensor([[0.02, 0.01, 1.0]]) + torch.arange(8)[:, None] * torch.tensor(
        [0, 0, 0.1]
    )
    arguments[2][:8], arguments[3][:8] = 0.5, 0.95


EXTREMES = {
    "behind the camera": put("means", [0.0, 0.0, -1.0], culled=True),
    "at the near plane": put("means", [0.0, 0.0, 0.01], culled=True),
    "just beyond the near plane": put("means", [0.0, 0.0, 0.011]),
    "beyond the far plane": put("means", [0.0, 0.0, 2e10], culled=True),
    "far outside the view": put("means", [1e4, 0.0, 1.0], culled=True),
    "nan mean": put("means", [0.0, torch.nan, 1.0], culled=True),
    "nan depth": put("means", [0.0, 0.0, torch.nan], culled=True),
    "infinite mean": put("means", [torch.inf, 0.0, 1.0], culled=True),
    "nan quaternion": put("quats", [1.0, torch.nan, 0.0, 0.0], culled=True),
    "infinite quaternion": put("quats", [1.0, torch.inf, 0.0, 0.0], culled=True),
    "nan scale": put("scales", [0.1, torch.nan, 0.1], culled=True),
    "infinite scale": put("scales", [0.1, torch.inf, 0.1], culled=True),
    "nan opacity": put("opacities", torch.nan, culled=True),
    "infinite opacity": put("opacities", torch.inf, culled=True),
    "nan colour": put("colors", [0.5, torch.nan, 0.5], culled=True),
    "infinite colour": put("colors", [0.5, torch.inf, 0.5], culled=True),
    "zero quaternion": put("quats", [0.0] * 4, culled=True),
    "short quaternion": put("quats", [1e-10, 2e-10, -1e-10, 5e-11]),
    "long quaternion": put("quats", [1e20, 2e20, -1e20, 5e19]),
    "large covariance": put("scales", [1e3, 2e3, 3e3]),
    "huge covariance": put("scales", [1e15, 1e15, 1e15], culled=True),
    "largest covariance": put("scales", [3e38, 3e38, 3e38], culled=True),
    "no covariance": put("scales", [0.0, 0.0, 0.0]),
    "flat": put("scales", [0.3, 0.2, 0.0]),
    "needle": put("scales", [1e3, 1e-9, 1e-9]),
    "alpha above the ceiling": put("opacities", 0.999),
    "opacity under 1/255": put("opacities", 0.0039, culled=True),
    "negative opacity": put("opacities", -0.5, culled=True),
    "transmittance used up": (pile, False),
}


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_input_is_exact(name, backend, mode):
    spoil, culled = EXTREMES[name]
    arguments = scene(channels=3)
    arguments[0][3] = torch.tensor([0.05, 0.02, 1.5])
    spoil(arguments)
    _, _, grads, meta = found = check(arguments, backend=backend, rasterize_mode=mode)
    if culled:
        others = torch.arange(150) != 3
        width, height = found[0].shape[2], found[0].shape[1]
        weights, _ = loss_weights(
            [a[others] for a in arguments], width, height, rasterize_mode=mode
        )
        dtype = torch.float64 if backend == "reference" else torch.float32
        without = gradients(
            [a[others] for a in arguments], dtype, backend, weights, rasterize_mode=mode
        )
        assert torch.equal(found[0], without[0]) and torch.equal(found[1], without[1])
        assert all((g[3] == 0).all() for g in [*grads[:5], grads[5][0]])
        assert (
            name not in ("behind the camera", "zero quaternion", "nan mean")
            or meta["radii"][0, 3] == 0
        )


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_needle_has_exact_gradients_of_its_own(backend):
    # by itself: beside others its gradients would hide in their norm
    arguments = [a[:1] for a in scene(channels=3)]
    arguments[0], arguments[2] = (
        torch.tensor([[0.05, 0.02, 1.5]]),
        torch.tensor([[1e3, 1e-9, 1e-9]]),
    )
    check(arguments, backend=backend)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("shape", [[1.0, 0.02, 0.001], [0.3, 0.01, 0.0], [0.02, 0.01, 0.015]])
def test_compensation_has_exact_gradients_of_its_own(shape, backend):
    arguments = [a[:1] for a in scene(channels=3)]
    arguments[0], arguments[2] = torch.tensor([[0.05, 0.02, 1.5]]), torch.tensor([shape])
    arguments[3][:] = 0.9
    grads = check(arguments, backend=backend, rasterize_mode="antialiased")[2]
    assert all(g.abs().max() > 0 for g in grads)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3])
def test_compensation_ends_at_its_floor_and_has_no_gradient_there(size, backend):
    viewmats, K, width, height = camera(9, 9)
    arguments = [
        torch.tensor([[0.0, 0, 2]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), size),
    ]
    arguments = [
        a.requires_grad_(True) for a in (*arguments, torch.tensor([0.9]), torch.ones(1, 1))
    ]
    options = {"rasterize_mode": "antialiased", "backend": backend}
    # the mean's own pixel
    alpha = rasterize(*arguments, viewmats, K, width, height, **options)[1][0, 4, 4, 0]
    torch.testing.assert_close(alpha.detach(), torch.tensor(0.9 * 0.005))
    alpha.backward()
    torch.testing.assert_close(arguments[3].grad, torch.tensor([0.005]))
    assert arguments[2].grad.abs().max() < 1e-6  # 2.6 at a scale of 1e-3 without the floor


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("n", [0, 5])
def test_nothing_in_view_is_the_background_with_zero_gradients(n, backend):
    arguments, dtype = (
        [a[:n] for a in scene(channels=3)],
        torch.float64 if backend == "reference" else torch.float32,
    )
    arguments[0][:, 2] = -1
    background = torch.tensor([[0.25, 0.5, 0.75]], dtype=dtype, requires_grad=True)
    weights = torch.ones(1, 37, 53, 3)
    render, alpha, grads, _ = gradients(arguments, dtype, backend, weights, backgrounds=background)
    assert (render == background.detach()).all() and (alpha == 0).all()
    assert [len(g) for g in grads[:5]] == [n] * 5
    assert all((g == 0).all() for g in grads)
    assert (background.grad == 37 * 53).all()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_non_finite_image_gradient_is_an_error_that_names_the_view(backend):
    weights = torch.ones(2, 37, 53, 3)
    weights[1, 3, 3, 0] = torch.nan
    dtype = torch.float64 if backend == "reference" else torch.float32
    with pytest.raises(ValueError, match="view 1 is not finite"):
        gradients(scene(channels=3), dtype, backend, weights)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_an_unknown_mode_is_refused(backend):
    with pytest.raises(ValueError, match="neither classic nor antialiased"):
        rasterize(*scene(channels=3), *camera(), backend=backend, rasterize_mode="smooth")
