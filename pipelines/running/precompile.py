"""Compiles a training's kernels in parallel: the first training on a machine starts twice as fast.

Numba compiles a kernel at its first call with new argument types, one after the other on one core.
Here each part of a training is called with tiny arguments in a process of its own, and finds its
kernels in the cache afterwards. A run begins with it, as the stages before a training leave
processors idle.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np

N, WIDTH, HEIGHT, CHANNELS = 8, 32, 32, 32


def rasterizer() -> None:
    """An image of a few Gaussians."""
    import torch

    from chebsplat.rasterize import rasterize

    g = torch.Generator().manual_seed(0)
    means, quats, scales = (
        torch.randn(N, 3, generator=g),
        torch.randn(N, 4, generator=g),
        torch.full((N, 3), 0.1),
    )
    camera = (
        torch.eye(4)[None],
        torch.tensor([[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]]),
        WIDTH,
        HEIGHT,
    )
    rasterize(
        means,
        quats,
        scales,
        torch.full((N,), 0.5),
        torch.rand(N, 3),
        *camera,
        cell_colors=torch.rand(N, 4),
    )


def adjoints() -> None:
    """The rasterizer's gradients, of an image of one empty tile."""
    from chebsplat.rasterize import ellipses, tiles_adjoint
    from chebsplat.rasterize.binning import TILE

    def empty(*shape: int, kind: type = np.float32) -> np.ndarray:
        return np.zeros(shape, kind)

    bins = (
        empty(0, kind=np.int32),
        empty(2, kind=np.int64),
        *(empty(0, kind=np.int32),) * 2,
        empty(1, 1, kind=np.int32),
    )
    visible = empty(0, kind=np.uint16), empty(1, kind=np.int64), np.float32(0.99)
    slopes = empty(TILE, TILE, 3), empty(TILE // 4, TILE // 4, 4), empty(TILE, TILE)
    tiles_adjoint.backward(0, empty(1, 2 * TILE), *bins, *visible, *slopes, False)
    gaussians, camera = (
        (empty(0, 3), empty(0, 4), empty(0, 3)),
        (np.eye(4), np.eye(3), TILE, TILE, 0.3),
    )
    ellipses.project_adjoint(
        *gaussians, *camera, empty(0, kind=np.int32), empty(0, 2), empty(0, 3), empty(0)
    )


def colors() -> None:
    """SH colours, with and without masks."""
    import torch

    from chebsplat.splats.sh_kernels import colors_in_view

    bands = [torch.randn(N, 2 * band + 1, 3, requires_grad=True) for band in range(4)]
    for masks in (torch.ones(N, 3, requires_grad=True), None):
        colors_in_view(
            bands, masks, torch.arange(N), torch.randn(N, 3), torch.zeros(3), 3
        ).sum().backward()


def losses() -> None:
    """Photometric and feature losses, and a step of Adam."""
    import torch

    from chebsplat.training.adam import adam
    from chebsplat.training.losses import feature_distance, photometric

    render = torch.rand(HEIGHT, WIDTH, 3, requires_grad=True)
    photometric(render, torch.rand(HEIGHT, WIDTH, 3), None, 0.2).backward()
    features = torch.rand(HEIGHT // 4, WIDTH // 4, CHANNELS, requires_grad=True)
    feature_distance(features, torch.rand(HEIGHT // 4, WIDTH // 4, CHANNELS)).backward()
    adam([{"params": [render]}]).step()


def regions() -> None:
    """Centres of regions."""
    from chebsplat.shape.regions import farthest_points

    farthest_points(np.eye(3), 2, 0)


def lifting() -> None:
    """A lift of features, before and after a training."""
    from chebsplat.lifting.observations import estimate, gathered
    from chebsplat.rasterize.lift import lift

    rng = np.random.default_rng(0)
    means, flat = (
        rng.normal((0, 0, 3), 1, (4 * N, 3)).astype(np.float32),
        np.ones((4 * N, 3), np.float32),
    )
    quats, K = (
        rng.normal(size=(4 * N, 4)).astype(np.float32),
        np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]),
    )
    cells = np.ones((HEIGHT // 4, WIDTH // 4, CHANNELS), np.float32)
    observations = lift(
        (means, quats, 0.1 * flat, 0.5 * flat[:, 0]),
        np.eye(4),
        K,
        (WIDTH, HEIGHT),
        cells,
        cells[..., 0],
    )
    estimate(gathered(4 * N, CHANNELS, [observations]), 1)


def descriptors() -> None:
    """Descriptors of points, which follow a training."""
    from chebsplat.shape.point_inputs import point_inputs

    means, shapes = (
        np.random.default_rng(0).normal(0, 1, (4 * N, 3)),
        np.tile(np.eye(3), (4 * N, 1, 1)),
    )
    point_inputs(means, np.tile([0.0, 0, 1], (4 * N, 1)), shapes, up=np.array([0, 0, 1.0]))


NEEDED = (colors, losses, regions, adjoints, rasterizer)  # by any training
SEMANTIC = (lifting, descriptors)  # by one with features
# a lift contains the kernels of an image
SIDE_BY_SIDE = (rasterizer, lifting), (adjoints,), (losses, colors, regions)


@contextmanager
def precompile(n_threads: int, semantic: bool) -> Iterator[None]:
    """Compile a training's kernels before the block, and those of later stages during it.

    Choices: nothing is done where all are cached or no cache can be written, or with one thread.
      Where another process compiles, this one compiles the remaining parts, and waits for it.
    """
    from chebsplat.kernels.jit import FOLDER

    if (
        FOLDER is None
        or n_threads < 2
        or all(is_compiled(part) for part in (*NEEDED, *SEMANTIC * semantic))
    ):
        yield
        return
    before, behind = (*NEEDED, *SEMANTIC[:1] * semantic), SEMANTIC[1:] * semantic
    with ExitStack() as processes:
        if not any(is_locked(part) for part in before):
            chains = [[part for part in chain if part in before] for chain in SIDE_BY_SIDE]
            for process in [processes.enter_context(compiler_process(chain)) for chain in chains]:
                process.join()
        for part in before:
            compile_once(part)
        followers = [processes.enter_context(compiler_process([part])) for part in behind]
        yield
        for process in followers:
            process.join()


@contextmanager
def compiler_process(parts: Sequence[Callable[[], None]]) -> Iterator[BaseProcess]:
    """A process that compiles parts, and ends with the block; forked with its imports done."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["chebsplat.pipelines.running.compiler"])
    process = context.Process(target=compile_parts, args=(5, *parts), daemon=True)
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def compile_parts(niceness: int, *parts: Callable[[], None]) -> None:
    """Compile parts in a low-priority process, which ends with its parent."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(niceness)
    for part in parts:
        compile_once(part)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()  # however it ends
        os._exit(1)


def compile_once(part: Callable[[], None]) -> None:
    """Compile a part unless it is cached; waits for another process that does, by a lock."""
    with open(_lock(part), "w") as lock:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_compiled(part):
            part()
            _mark(part).touch()


def is_locked(part: Callable[[], None]) -> bool:
    """True where another process is compiling a part."""
    with open(_lock(part), "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # a file system without locks
            pass
    return False


def is_compiled(part: Callable[[], None]) -> bool:
    """True where the kernels of a part are in the cache."""
    return _mark(part).exists()


def _mark(part: Callable[[], None]) -> Path:
    from chebsplat.kernels.jit import FOLDER

    assert FOLDER is not None
    return FOLDER / f"rehearsed-{part.__name__}"


def _lock(part: Callable[[], None]) -> Path:
    return _mark(part).with_suffix(".lock")
