"""Rendering of a finished scene, in which a Gaussian costs only the SH bands that it keeps.

`frame_parts` takes the steps of `SceneRenderer.render` on the CPU one by one under a clock.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.kernels.dispatch import one_torch_thread
from chebsplat.rasterize import binning, ellipses, rasterize, tiles
from chebsplat.rasterize.cuda import made_harmless
from chebsplat.rasterize.depths import depths
from chebsplat.splats.exposure import exposed
from chebsplat.splats.gaussians import activated, surface_of, take
from chebsplat.splats.planes import inverse_depths
from chebsplat.splats.sh import eval_sh
from chebsplat.splats.sh_kernels import colors_by_degree
from chebsplat.views import View, in_frustum

PARTS = ("projection", "sh", "sort", "blend")
NEAR, FAR, BLUR, MAX_ALPHA = 0.01, 1e10, 0.3, 0.99  # the defaults of `rasterize`


def focals(Ks: Tensor | np.ndarray) -> np.ndarray:
    """Focal lengths [...] of K [..., 3, 3], pixels: the mean of both axes'."""
    focal: np.ndarray = np.asarray(Ks[..., 0, 0] + Ks[..., 1, 1]) / 2
    return focal


class SceneRenderer:
    """Renders an exported scene (`formats.scene.Scene.parameters`); its depth always on the CPU.

    Ks: [V, 3, 3] of the cameras that the scene was trained on. A view that is finer than all of
      them is blurred as much as theirs were, since what was trained under their blur is too thin
      without; None: every view has the rasterizer's own blur.
    """

    def __init__(
        self, parameters: dict[str, np.ndarray], device: str = "cpu", Ks: np.ndarray | None = None
    ):
        raw = {
            name: torch.from_numpy(np.ascontiguousarray(values)).to(device)
            for name, values in parameters.items()
        }
        self.on_gpu = raw["means"].device.type == "cuda"
        self.finest = math.inf if Ks is None else float(focals(Ks).max())
        means, quats, scales, opacities = activated(raw)
        if self.on_gpu:
            lights = {name: raw[name] for name in ("sh0", "shN", "features") if name in raw}
            flat = torch.cat([part.flatten(1) for part in lights.values()], 1)
            means, quats, scales, opacities, flat = made_harmless(
                means, quats, scales, opacities, flat
            )
            parts = flat.split([part.shape[1:].numel() for part in lights.values()], 1)
            raw |= {
                name: part.reshape(lights[name].shape)
                for name, part in zip(lights, parts, strict=True)
            }
        self.means, self.quats, self.scales, self.opacities = means, quats, scales, opacities
        self.raw, self.reach = raw, 3 * self.scales.amax(1)
        self.normals = torch.from_numpy(surface_of(parameters)[0])

    def colors(self, view: View, index: Tensor | None) -> Tensor:
        """Colours [V, 3] of these Gaussians (None: of all) as the view's camera sees them."""
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        sh0, shN = self.raw["sh0"], self.raw["shN"]
        if index is not None:
            return colors_by_degree(sh0, shN, self.raw["degrees"], index, self.means, eye)
        # all bands of all, those above a degree being zero: to choose costs more on a GPU
        return eval_sh(sh0, shN, self.means - eye, math.isqrt(shN.shape[1] + 1) - 1)

    @torch.no_grad()
    @one_torch_thread()
    def render(
        self, view: View, with_features: bool = False, stops: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Image u8 [H, W, 3], after so many more stops [3], and features f32 [H, W, C] where asked
        for and present.
        """
        finer = 1.0 if self.finest == math.inf else max(float(focals(view.K)) / self.finest, 1.0)
        view = view.to(self.means.device)
        # nothing waits for their number
        index = None if self.on_gpu else in_frustum(self.means, view, self.reach)
        channels = self.colors(view, index)
        if with_features and "features" in self.raw:
            channels = torch.cat([channels, take(self.raw["features"], index)], 1)
        gaussians = (
            take(part, index) for part in (self.means, self.quats, self.scales, self.opacities)
        )
        camera = (view.viewmat[None], view.K[None], view.width, view.height)
        options: dict[str, Any] = {"eps2d": BLUR * finer**2}
        if self.on_gpu:  # an option of this backend alone
            options["harmless"] = True
        render, _, _ = rasterize(*gaussians, channels, *camera, **options)
        rgb = render[0, ..., :3]
        if stops is not None:
            rgb = exposed(rgb, torch.from_numpy(stops).to(rgb))
        image = (rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()
        return image, render[0, ..., 3:].cpu().numpy() if channels.shape[1] > 3 else None

    @torch.no_grad()
    def render_depth(self, view: View, nearest: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
        """Depth along the camera's axis f32 [H, W], scene units, and coverage f32 [H, W] in [0, 1].

        Args: nearest: scene units; what is nearer has no depth.
        Returns: depth is nan where nothing is covered.
        Choices: Gaussians are planes (`splats.planes.inverse_depths`), whose depth
          `rasterize.depths` takes where most of a pixel's light has been gathered: their mean lies
          in front of walls.
        """
        index = in_frustum(self.means, view.to(self.means.device), self.reach).cpu()
        K, pose = view.K.double().cpu(), view.viewmat.double().cpu()
        parts = (self.means, self.quats, self.scales, self.opacities)
        gaussians = tuple(part.cpu()[index] for part in parts)
        means, normals = (
            values.double() @ pose[:3, :3].T for values in (gaussians[0], self.normals[index])
        )
        planes = inverse_depths(means + pose[:3, 3], normals, K, nearest)
        arrays = tuple(part.numpy() for part in gaussians)
        depth, covered = depths(
            arrays, pose.numpy(), K.numpy(), (view.width, view.height), planes.numpy()
        )
        return np.where(
            (covered > 1e-3) & (depth > nearest) & np.isfinite(depth), depth, np.float32(np.nan)
        ), covered


@torch.no_grad()
@one_torch_thread()
def frame_parts(renderer: SceneRenderer, view: View) -> tuple[dict[str, float], np.ndarray]:
    """Seconds of each of PARTS for one frame in colour alone, and the frame, u8 [H, W, 3], as
    `render` gives it.

    Choices: culling belongs to projection; packing the sorted splats to the sort; rounding to 8
      bits to the blend.
    """
    clock = [time.perf_counter()]
    index = in_frustum(renderer.means, view, renderer.reach)
    means, quats, scales, opacities = (
        t[index].contiguous()
        for t in (renderer.means, renderer.quats, renderer.scales, renderer.opacities)
    )
    camera = (
        view.viewmat.double().numpy(),
        view.K.double().numpy(),
        view.width,
        view.height,
        NEAR,
        FAR,
        BLUR,
    )
    projected = ellipses.project(means.numpy(), quats.numpy(), scales.numpy(), *camera)
    centers, covariances, whitening, _, depths, radii, _ = projected
    clock.append(time.perf_counter())
    colors = renderer.colors(view, index).numpy()
    clock.append(time.perf_counter())
    strengths, size, none = opacities.numpy(), (view.width, view.height), colors[:, :0]
    bins = binning.bin_gaussians(
        centers, covariances, depths, radii, strengths, colors, none, *size
    )
    splats = tiles.pack(bins.order, centers, whitening, strengths, colors, none)
    clock.append(time.perf_counter())
    image, *_ = tiles.forward(
        splats, bins.tile_starts, bins.rank, 3, 0, *size, np.float32(MAX_ALPHA)
    )
    frame = (torch.from_numpy(image).clamp(0, 1) * 255).round().byte().numpy()
    clock.append(time.perf_counter())
    return dict(zip(PARTS, np.diff(clock).tolist(), strict=True)), frame
