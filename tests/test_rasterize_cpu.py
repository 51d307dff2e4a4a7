"""The numba backend equals the plain-torch oracle, in value and gradient, and never depends on thread count."""

import numba
import pytest
import torch
from raster import camera, gradients, scene

from chebsplat.rasterize import rasterize


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(("channels", "n"), [(4, 150), (19, 3000)])
def test_any_number_of_threads_gives_the_same_bits(channels, n, mode):
    weights = torch.randn(2, 61, 83, channels, generator=torch.Generator().manual_seed(2))
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, 2, min(4, before)):
            numba.set_num_threads(threads)
            options = {"backend": "cpu", "rasterize_mode": mode, "absgrad": True}
            render, alpha, grads, meta = gradients(scene(n, channels), torch.float32, weights=weights, **options)
            results.append([render, alpha, *grads, meta["means2d"].absgrad])
    finally:
        numba.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


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
