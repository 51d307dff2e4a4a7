"""The numba backend equals the plain-torch oracle, in value and gradient, and never depends on
thread count.
"""

import pytest
import torch
from raster import camera, gradients, scene
from thread_counts import assert_same_bits

from chebsplat.rasterize import rasterize


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(("channels", "n"), [(4, 150), (19, 3000)])
def test_any_number_of_threads_gives_the_same_bits(channels, n, mode):
    weights = torch.randn(2, 61, 83, channels, generator=torch.Generator().manual_seed(2))

    def rendered():
        options = {"rasterize_mode": mode, "absgrad": True}
        found = gradients(scene(n, channels), torch.float32, "cpu", weights, **options)
        return [*found[:2], *found[2], found[3]["means2d"].absgrad]

    assert_same_bits(rendered)


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
        rasterize(
            *scene(channels=3), viewmats.requires_grad_(True), K, width, height, backend="cpu"
        )


def test_two_trainings_side_by_side_get_what_each_gets_alone():
    import threading

    weights = torch.randn(1, 61, 83, 8, generator=torch.Generator().manual_seed(3))
    alone = [gradients(scene(800, 8, seed), torch.float32, "cpu", weights)[2] for seed in (0, 1)]
    together: dict[int, list] = {0: [], 1: []}

    def train(seed):
        for _ in range(20):
            together[seed].append(gradients(scene(800, 8, seed), torch.float32, "cpu", weights)[2])

    workers = [threading.Thread(target=train, args=(seed,)) for seed in (0, 1)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for seed in (0, 1):
        assert len(together[seed]) == 20
        assert all(
            torch.equal(a, b)
            for found in together[seed]
            for a, b in zip(found, alone[seed], strict=True)
        )


def _gradients_elsewhere(_):
    weights = torch.randn(1, 61, 83, 8, generator=torch.Generator().manual_seed(3))
    return [g.numpy() for g in gradients(scene(800, 8), torch.float32, "cpu", weights)[2]]


def test_a_spawned_process_gets_the_same_bits():
    import multiprocessing

    here = _gradients_elsewhere(0)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        for found in pool.map(_gradients_elsewhere, range(2)):
            assert all((a == b).all() for a, b in zip(here, found, strict=True))
