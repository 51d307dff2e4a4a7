"""Compiling what a training needs, side by side: the first one on a machine waits half as long for its first step.

Numba compiles a kernel when it first meets a kind of arguments, one after the other on one core. Here each part of a
training meets tiny ones, in a process of its own; what it compiles is kept, and found by the training. A run begins
with it: what comes before a training leaves processors idle.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

N, WIDTH, HEIGHT, CHANNELS = 8, 32, 32, 32


def rasterizer() -> None:
    """A picture of few Gaussians."""
    import torch

    from chebsplat.rasterize import rasterize

    g = torch.Generator().manual_seed(0)
    means, quats, scales = torch.randn(N, 3, generator=g), torch.randn(N, 4, generator=g), torch.full((N, 3), 0.1)
    camera = torch.eye(4)[None], torch.tensor([[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]]), WIDTH, HEIGHT
    rasterize(means, quats, scales, torch.full((N,), 0.5), torch.rand(N, 3), *camera, cell_colors=torch.rand(N, 4))


def adjoints() -> None:
    """The rasterizer's gradients, of a picture of one tile that shows nothing."""
    import numpy as np

    from chebsplat.rasterize import ellipses, tiles_adjoint
    from chebsplat.rasterize.binning import TILE

    def none(*shape: int, kind: type = np.float32) -> np.ndarray:
        return np.zeros(shape, kind)

    bins = none(0, kind=np.int32), none(2, kind=np.int64), *(none(0, kind=np.int32),) * 2, none(1, 1, kind=np.int32)
    seen = none(0, kind=np.uint16), none(1, kind=np.int64), np.float32(0.99)
    slopes = none(TILE, TILE, 3), none(TILE // 4, TILE // 4, 4), none(TILE, TILE)
    tiles_adjoint.backward(0, none(1, 2 * TILE), *bins, *seen, *slopes, False)
    gaussians, camera = (none(0, 3), none(0, 4), none(0, 3)), (np.eye(4), np.eye(3), TILE, TILE, 0.3)
    ellipses.project_adjoint(*gaussians, *camera, none(0, kind=np.int32), none(0, 2), none(0, 3), none(0))


def colors() -> None:
    """SH colours, with and without masks."""
    import torch

    from chebsplat.splats.sh_kernels import colors_in_view

    bands = [torch.randn(N, 2 * band + 1, 3, requires_grad=True) for band in range(4)]
    for masks in (torch.ones(N, 3, requires_grad=True), None):
        colors_in_view(bands, masks, torch.arange(N), torch.randn(N, 3), torch.zeros(3), 3).sum().backward()


def losses() -> None:
    """Photometric and feature losses."""
    import torch

    from chebsplat.training.losses import feature_distance, photometric

    render = torch.rand(HEIGHT, WIDTH, 3, requires_grad=True)
    photometric(render, torch.rand(HEIGHT, WIDTH, 3), None, 0.2).backward()
    features = torch.rand(HEIGHT // 4, WIDTH // 4, CHANNELS, requires_grad=True)
    feature_distance(features, torch.rand(HEIGHT // 4, WIDTH // 4, CHANNELS)).backward()


def lifting() -> None:
    """A lift of features, which a training starts from and is followed by."""
    import numpy as np

    from chebsplat.lifting.observations import estimate, gathered
    from chebsplat.rasterize.lift import lift

    rng = np.random.default_rng(0)
    means, flat = rng.normal((0, 0, 3), 1, (4 * N, 3)).astype(np.float32), np.ones((4 * N, 3), np.float32)
    quats, K = rng.normal(size=(4 * N, 4)).astype(np.float32), np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    cells = np.ones((HEIGHT // 4, WIDTH // 4, CHANNELS), np.float32)
    said = lift((means, quats, 0.1 * flat, 0.5 * flat[:, 0]), np.eye(4), K, (WIDTH, HEIGHT), cells, cells[..., 0])
    estimate(gathered(4 * N, CHANNELS, [said]), 1)


def descriptors() -> None:
    """Descriptors of points, which follow a training."""
    import numpy as np

    from chebsplat.shape.point_inputs import point_inputs

    means, shapes = np.random.default_rng(0).normal(0, 1, (4 * N, 3)), np.tile(np.eye(3), (4 * N, 1, 1))
    point_inputs(means, np.tile([0.0, 0, 1], (4 * N, 1)), shapes, up=np.array([0, 0, 1.0]))


NEEDED = (rasterizer, adjoints, colors, losses)  # of any training
SEMANTIC = (lifting, descriptors)  # of one that is taught features


@contextmanager
def rehearsed(n_threads: int, semantic: bool) -> Iterator[None]:
    """Within, what a training needs has been compiled; what follows a semantic one has been when the block ends.

    Choices: the kernels of a picture and of a lift, which uses them, here, the others in processes of their own.
      Nothing is done where all is kept already or nothing can be, and with one thread.
    """
    from multiprocessing import get_context

    from chebsplat.kernels.jit import FOLDER

    if FOLDER is None or n_threads < 2 or all(is_kept(part) for part in (*NEEDED, *SEMANTIC * semantic)):
        yield
        return
    new = partial(get_context("spawn").Process, target=alone, daemon=True)
    beside = [new(args=(5, *parts)) for parts in ((adjoints,), (colors, losses))]
    behind = [new(args=(5, descriptors))] if semantic else []
    for process in beside:
        process.start()
    try:
        once(rasterizer)
        if semantic:
            once(lifting)
        for process in beside:
            process.join()
        for process in behind:
            process.start()
        yield
        for process in behind:
            process.join()
    finally:
        for process in (*beside, *behind):
            if process.pid is not None:
                process.kill()
                process.join()


def alone(niceness: int, *parts: Callable[[], None]) -> None:
    """Rehearse parts in a process of its own, which gives way to others."""
    os.nice(niceness)
    for part in parts:
        once(part)


def once(part: Callable[[], None]) -> None:
    """Rehearse a part unless that was done; another process that is at it is waited for, where files can be locked."""
    import fcntl

    with open(_mark(part).with_suffix(".lock"), "w") as lock:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_kept(part):
            part()
            _mark(part).touch()


def is_kept(part: Callable[[], None]) -> bool:
    """Whether what a part needs was compiled, and is kept."""
    return _mark(part).exists()


def _mark(part: Callable[[], None]) -> Path:
    from chebsplat.kernels.jit import FOLDER

    assert FOLDER is not None
    return FOLDER / f"rehearsed-{part.__name__}"
