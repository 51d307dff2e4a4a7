"""The rasterizer's memory is bounded by what it draws, and does not grow with use.

Measured in a process of its own, this file with a function's name: the kernel keeps the peak of the
resident set, and writing 5 to /proc/self/clear_refs starts it anew.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from shared import ROOT

from chebsplat.rasterize import rasterize, reference
from chebsplat.rasterize.projection import project

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]
N, CHANNELS, ITERATIONS = 20_000, 19, 10_000


def resident(which):
    """Bytes: VmRSS now, or VmHWM at the peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(which)).split()[1])


def iterate(arguments, view, gradients):
    render, alpha, _ = rasterize(*arguments, *view, backend="cpu")
    torch.autograd.backward([render, alpha], gradients)


def peak():
    """Growth of one forward and backward pass over its bound: 64 bytes a pair of a Gaussian and a
    tile, and images.
    """
    from benchmarks.raster import camera, scene

    view = viewmats, Ks, width, height = camera()
    gradients = [torch.rand(1, height, width, k) for k in (CHANNELS, 1)]
    for _ in range(3):  # neither compilation nor thread stacks count
        iterate(scene(N // 100, CHANNELS), view, gradients)
    arguments = scene(N, CHANNELS)
    means, quats, scales, opacities, _ = (a.detach() for a in arguments)
    seen = project(means, quats, scales, viewmats[0], Ks[0], (width, height), (0.01, 1e10), 0.3)
    shown = seen.visible & (opacities >= reference.ALPHA_MIN)
    table = torch.cat([seen.means2d, seen.whitening, opacities[:, None]], 1)[shown]
    tiles = -(-width // 16), -(-height // 16)
    n_pairs = len(reference._pairs(table, seen.covariances[shown], *tiles, width, height, 16)[0])
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    iterate(arguments, view, gradients)
    return (resident("VmHWM") - before) / (64 * n_pairs + 2 * 4 * width * height * (CHANNELS + 1))


def drift():
    """Bytes that are resident after all iterations over those after a tenth."""
    from benchmarks.raster import camera, scene

    arguments, gradients, after = scene(50, 3), [torch.rand(1, 16, 16, k) for k in (3, 1)], {}
    for k in range(1, ITERATIONS + 1):
        iterate(arguments, camera(16, 16), gradients)
        if k in (ITERATIONS // 10, ITERATIONS):
            after[k] = resident("VmRSS")
    return after[ITERATIONS] - after[ITERATIONS // 10]


def measured(name):
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, __file__, name]
    return json.loads(
        subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE).stdout
    )


def test_peak_is_64_bytes_a_pair_and_the_images():
    assert measured("peak") <= 1


def test_ten_thousand_iterations_leak_nothing():
    # over 9,000 of them: a leak of 120 bytes an iteration would show
    assert measured("drift") < 1 << 20


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]]()))
