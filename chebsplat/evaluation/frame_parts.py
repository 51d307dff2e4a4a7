"""Where the time of a frame goes: the steps of `SceneRenderer.render` on the CPU, one by one under a clock."""

from __future__ import annotations

import time

import numpy as np
import torch

from chebsplat.rasterize import binning, ellipses, tiles
from chebsplat.render import SceneRenderer, colors_by_degree
from chebsplat.views import View, in_frustum

PARTS = ("projection", "sh", "sort", "blend")
NEAR, FAR, BLUR, MAX_ALPHA = 0.01, 1e10, 0.3, 0.99  # the defaults of `rasterize`


@torch.no_grad()
def frame_parts(renderer: SceneRenderer, view: View) -> tuple[dict[str, float], np.ndarray]:
    """Seconds of each of PARTS for one frame in colour alone, and the frame, u8 [H, W, 3], as `render` gives it.

    Choices: culling belongs to projection; packing the sorted splats to the sort; rounding to 8 bits to the blend.
    """
    clock = [time.perf_counter()]
    index = in_frustum(renderer.means, view, renderer.reach)
    means, quats, scales, opacities = (
        t[index].contiguous() for t in (renderer.means, renderer.quats, renderer.scales, renderer.opacities)
    )
    camera = (view.viewmat.double().numpy(), view.K.double().numpy(), view.width, view.height, NEAR, FAR, BLUR)
    projected = ellipses.project(means.numpy(), quats.numpy(), scales.numpy(), *camera)
    centers, covariances, whitening, _, depths, radii, _ = projected
    clock.append(time.perf_counter())
    eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    sh0, shN, degrees = (renderer.raw[name][index] for name in ("sh0", "shN", "degrees"))
    colors = colors_by_degree(sh0, shN, means - eye, degrees).contiguous().numpy()
    clock.append(time.perf_counter())
    strengths, size, none = opacities.numpy(), (view.width, view.height), colors[:, :0]
    bins = binning.bin_gaussians(centers, covariances, depths, radii, strengths, colors, none, *size)
    splats = tiles.pack(bins.order, centers, whitening, strengths, colors, none)
    clock.append(time.perf_counter())
    image, *_ = tiles.forward(splats, bins.tile_starts, bins.rank, 3, 0, *size, np.float32(MAX_ALPHA))
    frame = (torch.from_numpy(image).clamp(0, 1) * 255).round().byte().numpy()
    clock.append(time.perf_counter())
    return dict(zip(PARTS, np.diff(clock).tolist(), strict=True)), frame
