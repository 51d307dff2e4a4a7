"""Compiling what a training needs, side by side: the first one on a machine waits half as long for its first step.

Numba compiles a kernel when it first meets a kind of arguments, one after the other on one core. Here each part of a
training meets tiny ones, in a process of its own; what it compiles is kept, and found by the training.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

N, WIDTH, HEIGHT, CHANNELS = 8, 32, 32, 32
MARK, LOCK = "rehearsed", ".rehearsal"


def rasterizer() -> None:
    """Colours alone, with depth, with features by cell: forward and backward."""
    import torch

    from chebsplat.rasterize import rasterize

    g = torch.Generator().manual_seed(0)
    means, quats, scales = torch.randn(N, 3, generator=g), torch.randn(N, 4, generator=g), torch.full((N, 3), 0.1)
    leaves = [means, quats, scales, torch.full((N,), 0.5), torch.rand(N, 3, generator=g), torch.rand(N, CHANNELS)]
    *gaussians, cells = (leaf.requires_grad_() for leaf in leaves)
    camera = torch.eye(4)[None], torch.tensor([[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]]), WIDTH, HEIGHT
    for cell_colors in (None, cells):
        render, alpha, meta = rasterize(*gaussians, *camera, cell_colors=cell_colors)
        (render.sum() + alpha.sum() + (meta["cells"].sum() if "cells" in meta else 0)).backward()


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


def afterwards() -> None:
    """Lifting and descriptors of points, which follow a training."""
    import numpy as np

    from chebsplat.lifting.observations import estimate, gathered
    from chebsplat.rasterize.lift import lift
    from chebsplat.shape.point_inputs import point_inputs

    rng = np.random.default_rng(0)
    means, flat = rng.normal((0, 0, 3), 1, (4 * N, 3)), np.ones((4 * N, 3), np.float32)
    quats, K = rng.normal(size=(4 * N, 4)).astype(np.float32), np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    gaussians = means.astype(np.float32), quats, 0.1 * flat, 0.5 * flat[:, 0]
    cells = np.ones((HEIGHT // 4, WIDTH // 4, CHANNELS), np.float32)
    said = lift(gaussians, np.eye(4), K, (WIDTH, HEIGHT), cells, cells[..., 0])
    estimate(gathered(4 * N, CHANNELS, [said]), 1)
    shapes = np.tile(np.eye(3), (4 * N, 1, 1))
    point_inputs(means, np.tile([0.0, 0, 1], (4 * N, 1)), shapes, up=np.array([0, 0, 1.0]))


@contextmanager
def rehearsed(n_threads: int, semantic: bool) -> Iterator[None]:
    """Within, what a training needs has been compiled; what follows a semantic one may still be.

    Choices: the rasterizer's kernels here, the others in processes of their own, which end with the block at the
      latest. Nothing is done where all is kept already or nothing can be, where another process is at it, and with one
      thread alone.
    """
    import fcntl
    from multiprocessing import get_context

    from chebsplat.kernels.jit import FOLDER

    if FOLDER is None or n_threads < 2 or (FOLDER / MARK).exists():
        yield
        return
    with open(FOLDER / LOCK, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield
            return
        new = partial(get_context("spawn").Process, target=alone, daemon=True)
        beside, behind = new(args=(colors, losses)), new(args=(afterwards,))
        started = [beside, behind] if semantic else [beside]
        for process in started:
            process.start()
        try:
            rasterizer()
            beside.join()
            yield
            if all(process.exitcode == 0 for process in (beside, behind)):
                (FOLDER / MARK).touch()
        finally:
            for process in started:
                process.kill()
                process.join()


def alone(*parts: Callable[[], None]) -> None:
    """Rehearse parts in a process of its own, which gives way to others."""
    os.nice(5)
    for part in parts:
        part()
