"""Image figures of rendered views: PSNR, SSIM, LPIPS if there are weights; frames a second."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from scipy.ndimage import map_coordinates

from chebsplat.cameras import unproject
from chebsplat.errors import InputError
from chebsplat.evaluation.lpips import Lpips
from chebsplat.evaluation.metrics import color_fitted, psnr
from chebsplat.formats.capture import Capture
from chebsplat.formats.record import Stack
from chebsplat.kernels.threads import n_threads
from chebsplat.render import PARTS, SceneRenderer, focals, frame_parts
from chebsplat.training.losses import ssim
from chebsplat.views import View

LEAST_SIDE = 16  # pixels, of LPIPS
SAME_SURFACE = 0.05  # of a depth: two views that differ by less show the same surface


def image_figures(
    renders: np.ndarray,
    truth: np.ndarray,
    masks: list[np.ndarray] | None,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """PSNR, SSIM and LPIPS of 8-bit images, by view and in the mean; `lpips` None: not measured.

    Choices: masked pixels do not count; for SSIM and LPIPS they take the true colour. `psnr_fit` is
      the PSNR after an affine fit of a render's colours to its photo, independent of the photo's
      exposure and white balance.
    """
    names = ("psnr", "psnr_fit", "ssim", *(["lpips"] if lpips else []))
    per_view: dict[str, list[float]] = {name: [] for name in names}
    for k, (render, true) in enumerate(zip(renders, truth, strict=True)):
        counted = np.ones(true.shape[:2], bool) if masks is None else masks[k]
        filled = np.where(counted[..., None], render, true)
        pixels, target = render[counted], true[counted]
        per_view["psnr"].append(min(psnr(pixels, target), 100.0))
        per_view["psnr_fit"].append(min(psnr(color_fitted(pixels, target), target), 100.0))
        per_view["ssim"].append(ssim(filled, true))
        if lpips is not None:
            per_view["lpips"].append(lpips.distance(filled, true))
    means = {name: float(np.array(values).mean()) for name, values in per_view.items()}
    return {"lpips": None} | means | {"per_view": per_view}


def figures_where_shown(
    renders: np.ndarray, truth: np.ndarray, shown: list[np.ndarray]
) -> dict[str, Any] | None:
    """PSNR, dB, of the pixels that training photos show, `shown` bool [H, W] of each view, and
    their `share`; None where they show none of any.
    """
    psnrs = [
        min(psnr(render[pixels], true[pixels]), 100.0) if pixels.any() else None
        for render, true, pixels in zip(renders, truth, shown, strict=True)
    ]
    counted = [value for value in psnrs if value is not None]
    if not counted:
        return None
    share = float(np.mean([pixels.mean() for pixels in shown]))
    return {"psnr": float(np.mean(counted)), "share": share, "per_view": {"psnr": psnrs}}


def shown_pixels(
    views: Sequence[int],
    others: Sequence[int],
    depth: Stack,
    Ks: np.ndarray,
    cam_from_world: np.ndarray,
) -> list[np.ndarray]:
    """Pixels bool [H, W] of each view whose surface one of the `others` shows, by measured depth.

    Args: depth: f32 [V, H, W] z, scene units, nan where unknown: such pixels are not shown; Ks
      [V, 3, 3]; cam_from_world [V, 4, 4].
    """
    shown, left = [np.zeros(depth.shape[1:], bool) for _ in views], {}
    for view in views:
        own = depth[view]
        pixels = np.argwhere(own > 0)
        left[view] = pixels, unproject(own, Ks[view], cam_from_world[view], pixels)
    for other in others:
        pose, there = cam_from_world[other], depth[other]
        for view, mask in zip(views, shown, strict=True):
            if view == other or not len(left[view][0]):
                continue
            pixels, world = left[view]
            projected = (world @ pose[:3, :3].T + pose[:3, 3]) @ Ks[other].T
            z = np.where(projected[:, 2] > 0, projected[:, 2], np.nan)
            places = np.floor(projected[:, 1::-1] / z[:, None])
            found = ((places >= 0) & (places < there.shape)).all(1)  # nan is neither
            rows, columns = places[found].astype(int).T
            found[found] = np.abs(there[rows, columns] / z[found] - 1) < SAME_SURFACE
            mask[tuple(pixels[found].T)] = True
            left[view] = pixels[~found], world[~found]
    return shown


def figures_as_taken(
    capture: Capture, renderer: SceneRenderer, cameras: dict[str, View]
) -> dict[str, Any] | None:
    """PSNR, dB, and SSIM on the test photos as they were taken, of up to 1600 pixels a side, and
    `size`, width and height of most of them; None where none was undistorted or reduced.

    Args:    cameras: of the capture's views, by name.
    Choices: the scene is rendered at the photo's resolution, and interpolated, by cubic splines, at
      the photo's pixels. Pixels outside the undistorted view, or masked in it, do not count; for
      SSIM they take the photo's colour.
    """
    if capture.taken is None:
        return None
    import pycolmap

    per_view: dict[str, list[float]] = {"psnr": [], "ssim": []}
    sizes = []
    for k, (name, model, params, width, height) in enumerate(capture.lenses):
        if name not in cameras:
            continue
        lens = pycolmap.Camera(model=model, params=params, width=width, height=height)
        # one by one: photos are large
        truth = np.ascontiguousarray(capture.taken[k][:height, :width])
        finer = lens.mean_focal_length() / float(focals(cameras[name].K))
        view = enlarged(cameras[name], finer)
        K, render = view.K.double().numpy(), renderer.render(view)[0]
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(
            -1, 2
        )
        places = (lens.cam_from_img(pixels) @ K[:2, :2].T + K[:2, 2] - 0.5).T[::-1]
        inside = ((places >= 0) & (places <= [[view.height - 1], [view.width - 1]])).all(0)
        if capture.loss_mask is not None:
            mask = np.asarray(capture.loss_mask[capture.names.index(name)])
            row, column = ((places[:, inside] + 0.5) / finer).astype(int)
            inside[inside] = mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]
        channels = np.moveaxis(render.astype(np.float32), -1, 0)
        colors = np.stack(
            [map_coordinates(c, places[:, inside], np.float32, mode="nearest") for c in channels],
            -1,
        )
        filled = truth.copy().reshape(-1, 3)
        filled[inside] = colors.round().clip(0, 255)
        per_view["psnr"].append(min(psnr(filled[inside], truth.reshape(-1, 3)[inside]), 100.0))
        per_view["ssim"].append(ssim(filled.reshape(truth.shape), truth))
        sizes.append((width, height))
    if not sizes:
        return None
    means = {name: float(np.mean(values)) for name, values in per_view.items()}
    return means | {"size": list(mode(sizes)), "per_view": per_view}


def enlarged(view: View, factor: float) -> View:
    """A camera whose picture is `factor` times as fine, rounded up to whole pixels."""
    K = view.K * view.K.new_tensor([factor, factor, 1.0])[:, None]
    return View(K, view.viewmat, math.ceil(view.width * factor), math.ceil(view.height * factor))


def load_lpips(path: Path) -> Lpips:
    """LPIPS of a weights file, .safetensors or a .pth of tensors alone. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path} is missing; correct evaluate.lpips_weights")
    help_ = "one file with VGG-16's features.N and LPIPS' linK.model.1.weight is needed"
    try:
        state = (
            load_file(path)
            if path.suffix == ".safetensors"
            else torch.load(path, "cpu", weights_only=True)
        )
        return Lpips(state)
    except (
        SafetensorError,
        pickle.UnpicklingError,
        RuntimeError,
        EOFError,
        ValueError,
        AttributeError,
    ) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} holds no weights of LPIPS ({first}); {help_}") from None


def timing(
    renderer: SceneRenderer, cameras: list[View], repeats: int, semantic: bool
) -> dict[str, float]:
    """Frames a second over all views, the best of `repeats`: colour alone, and with features."""
    figures = {}
    for name, with_features in (("color", False), ("color_and_features", True)):
        if with_features and not semantic:
            continue
        best = float("inf")
        for _ in range(repeats):
            began = time.perf_counter()
            for view in cameras:
                renderer.render(view, with_features)
            best = min(best, time.perf_counter() - began)
        figures[name] = len(cameras) / best
    return figures


def frame_split(renderer: SceneRenderer, cameras: list[View], repeats: int) -> dict[str, Any]:
    """Milliseconds of a colour frame by part, best of `repeats` over all views; size, threads."""
    sweeps = []
    for _ in range(repeats):
        frames = [frame_parts(renderer, view)[0] for view in cameras]
        sweeps.append(
            {part: 1000 * sum(parts[part] for parts in frames) / len(cameras) for part in PARTS}
        )
    size = {"width": cameras[0].width, "height": cameras[0].height}
    best = min(sweeps, key=lambda sweep: sum(sweep.values()))
    return best | size | {"threads": n_threads(), "device": "cpu"}
