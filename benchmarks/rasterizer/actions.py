"""What is timed: whole steps by backend, the stages of the kernel one by one, and multiply-adds that fill the pipes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

import numba
import numpy as np
import torch

from benchmarks.rasterizer.memory import camera, scene
from chebsplat.rasterize import binning, ellipses, rasterize, reference, tiles, tiles_adjoint
from chebsplat.training.losses import feature_distance, photometric

SIZE, N, CHANNELS = (320, 240), 20_000, 19


def threads(n: int) -> None:
    torch.set_num_threads(n)
    numba.set_num_threads(min(n, numba.config.NUMBA_NUM_THREADS))


def step(backend: str, n: int = N, channels: int = CHANNELS, dtype: torch.dtype = torch.float32) -> Callable[[], None]:
    """Forward, L1 and backward."""
    device = "cuda" if backend == "cuda" else "cpu"
    arguments = [a.detach().to(device, dtype).requires_grad_(True) for a in scene(n, channels)]
    viewmats, K, width, height = camera(*SIZE)
    target = torch.rand(1, height, width, channels, dtype=dtype, device=device)

    def run() -> None:
        for a in arguments:
            a.grad = None
        render, _, _ = rasterize(
            *arguments, viewmats.to(target), K.to(target), width, height, backend=backend, max_alpha=0.999
        )
        torch.nn.functional.l1_loss(render, target).backward()
        if device == "cuda":
            torch.cuda.synchronize()

    return run


def training_step(features: int, *, by_cell: bool) -> Callable[[], None]:
    """A training's step: three colours and `features` of a teacher at a quarter of the image's size, both losses."""
    arguments, (width, height) = [a.requires_grad_(True) for a in scene(N, 3 + features)], SIZE
    color, target = torch.rand(height, width, 3), torch.rand(height // 4, width // 4, features)

    def run() -> None:
        for a in arguments:
            a.grad = None
        *gaussians, channels = arguments
        if features and by_cell:
            parts = [part.contiguous() for part in channels.split([3, features], -1)]
            render, _, meta = rasterize(*gaussians, parts[0], *camera(*SIZE), backend="cpu", cell_colors=parts[1])
            image, rendered = render[0], meta["cells"][0]
        else:
            render = rasterize(*gaussians, channels, *camera(*SIZE), backend="cpu")[0][0]
            image, rendered = render.split([3, features], -1)
        loss = photometric(image, color, None, 0.2)
        (loss + feature_distance(rendered, target) if features else loss).backward()

    return run


def stages() -> dict[str, Callable[[], object]]:
    """The numba stages by themselves, without torch; `forward` and `backward` are the kernels."""
    means, quats, scales, opacities, colors = (t.detach().numpy() for t in scene(N, CHANNELS))
    viewmats, Ks, width, height = camera(*SIZE)
    view, ceiling = (viewmats[0].double().numpy(), Ks[0].double().numpy(), width, height), np.float32(0.999)
    gaussians, by_channel = (means, quats, scales), (opacities, colors, colors[:, :0])
    no_slope, no_cells = np.zeros(N, np.float32), np.zeros((height // 4, width // 4, 0), np.float32)
    rng = np.random.default_rng(0)
    grad = rng.random((height, width, CHANNELS), np.float32), no_cells, rng.random((height, width), np.float32)
    means2d, covariances, whitening, _, depths, radii, _ = ellipses.project(*gaussians, *view, 0.01, 1e10, 0.3)

    def bins() -> binning.Bins:
        return binning.bin_gaussians(means2d, covariances, depths, radii, *by_channel, width, height)

    found = bins()

    def pack() -> np.ndarray:
        return tiles.pack(found.order, means2d, whitening, *by_channel)

    splats = pack()

    def forward() -> tuple[np.ndarray, ...]:
        return tiles.forward(splats, found.tile_starts, found.rank, CHANNELS, 0, width, height, ceiling)

    _, _, _, *seen = forward()

    def backward() -> tuple[Any, ...]:
        return tiles_adjoint.backward(N, splats, *found, *seen, ceiling, *grad, False)

    to_means2d, moments, *_ = backward()
    return {
        "project": lambda: ellipses.project(*gaussians, *view, 0.01, 1e10, 0.3),
        "bin": bins,
        "pack": pack,
        "forward": forward,
        "backward": backward,
        "project back": lambda: ellipses.project_adjoint(*gaussians, *view, 0.3, radii, to_means2d, moments, no_slope),
    }


def loss() -> Callable[[], None]:
    """The training's loss of 3 channels of colour and the rest features, value and gradient."""
    width, height = SIZE
    image, target = torch.rand(height, width, CHANNELS, requires_grad=True), torch.rand(height, width, CHANNELS)

    def run() -> None:
        image.grad = None
        (color, features), (wanted_color, wanted) = (v.split([3, CHANNELS - 3], -1) for v in (image, target))
        (photometric(color, wanted_color, None, 0.2) + feature_distance(features, wanted)).backward()

    return run


def render_and_back() -> Callable[[], None]:
    """Forward and backward without any loss."""
    arguments, view = scene(N, CHANNELS), camera(*SIZE)
    grad = torch.rand(1, SIZE[1], SIZE[0], CHANNELS)

    def run() -> None:
        for a in arguments:
            a.grad = None
        rasterize(*arguments, *view, backend="cpu")[0].backward(grad)

    return run


@numba.njit(fastmath={"contract"}, inline="always")
def _sixteen(t: float, a: float, b: float) -> float:
    t = (((t * a + b) * a + b) * a + b) * a + b
    t = (((t * a + b) * a + b) * a + b) * a + b
    t = (((t * a + b) * a + b) * a + b) * a + b
    return (((t * a + b) * a + b) * a + b) * a + b


@numba.njit(fastmath={"contract"}, error_model="numpy")
def _multiply_add(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, a: float, b: float, repeats: int) -> None:
    """Sixteen dependent multiply-adds on each value of four small arrays: the pipes are full, memory idle."""
    for _ in range(repeats):
        for i in range(len(x)):
            w[i], x[i] = _sixteen(w[i], a, b), _sixteen(x[i], a, b)
            y[i], z[i] = _sixteen(y[i], a, b), _sixteen(z[i], a, b)


def multiply_adds() -> tuple[int, Callable[[], None]]:
    """How many multiply-adds the action does, and the action."""
    n, repeats = 256, 2000
    arrays = [np.ones(n, np.float32) for _ in range(4)]
    return 4 * 16 * n * repeats, lambda: _multiply_add(*arrays, np.float32(0.9), np.float32(0.1), repeats)


def contributions() -> int:
    """Contributing pairs of a pixel and a Gaussian."""
    counts, weights = [], reference._weights

    def counted(log_alphas: torch.Tensor, max_alpha: float) -> torch.Tensor:
        found = weights(log_alphas, max_alpha)
        counts.append(int(found.count_nonzero()))
        return found

    with mock.patch.object(reference, "_weights", counted), torch.no_grad():
        rasterize(*scene(N, CHANNELS), *camera(*SIZE), backend="reference", max_alpha=0.999)
    return sum(counts)
