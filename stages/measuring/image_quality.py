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
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.kernels.threads import n_threads
from chebsplat.labels.agreement import project, unhidden
from chebsplat.render import PARTS, SceneRenderer, focals, frame_parts
from chebsplat.training.losses import ssim
from chebsplat.views import View

LEAST_SIDE = 16  # pixels, of LPIPS
COVISIBLE_SIDE = 160  # pixels of the longer side of the grid that co-visibility is told on


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


def mean_psnr(renders: np.ndarray, truth: np.ndarray, masks: list[np.ndarray] | None) -> float:
    """Mean PSNR, dB, over views of 8-bit images; masked pixels do not count."""
    if masks is None:
        masks = [np.ones(image.shape[:2], bool) for image in truth]
    views = zip(renders, truth, masks, strict=True)
    return float(np.mean([min(psnr(a[counted], b[counted]), 100.0) for a, b, counted in views]))


def covisible_figures(
    capture: Capture, cameras: Cameras, names: Sequence[str], renders: np.ndarray
) -> dict[str, float] | None:
    """PSNR, dB, of the test views' co-visible pixels, whose surface a training photo shows, and
    their `share` of the pixels with measured depth; None where depth tells of none.

    Args: cameras: of the scene; names: of the test views; renders: u8 [T, H, W, 3] of them.
    Choices: on a grid of up to COVISIBLE_SIDE pixels a side, errors of all views pooled. Masked
      pixels do not count, nor do they show anything. Depth with noise beyond 3 % counts as hidden.
    """
    if capture.depth is None or capture.cam_from_world is None:
        return None
    row = {name: view for view, name in enumerate(capture.names)}
    place = {name: k for k, name in enumerate(cameras.names)}
    step, parts = -(-max(capture.size) // COVISIBLE_SIDE), []
    for name, render in zip(names, renders, strict=True):
        depth, K, pose = _posed_depth(capture, row[name], cameras, place[name])
        pixels = np.argwhere(np.isfinite(depth[::step, ::step])) * step
        rows, columns = pixels.T
        true = capture.images[row[name]][rows, columns]
        parts.append((unproject(depth, K, pose, pixels), render[rows, columns], true))
    points, rendered, true = (np.concatenate(part) for part in zip(*parts, strict=True))
    covisible = np.zeros(len(points), bool)
    for name in cameras.names:
        if name in row and not capture.is_test[row[name]]:
            depth, K, pose = _posed_depth(capture, row[name], cameras, place[name])
            left = ~covisible
            covisible[left] = unhidden(
                project(points[left], K, pose, capture.size), capture.size, depth
            )
    if not covisible.any():
        return None
    psnr_covisible = min(psnr(rendered[covisible], true[covisible]), 100.0)
    return {"psnr": psnr_covisible, "share": float(covisible.mean())}


def _posed_depth(
    capture: Capture, view: int, cameras: Cameras, place: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured depth [H, W] of a view, nan where unknown or masked, its K and cam_from_world."""
    assert capture.depth is not None
    depth = np.where(capture.depth[view] > 0, capture.depth[view], np.nan)
    depth[~np.isfinite(depth)] = np.nan
    if capture.loss_mask is not None:
        depth[~capture.loss_mask[view]] = np.nan
    return depth, cameras.Ks[place], cameras.cam_from_world[place]


def figures_as_taken(
    capture: Capture,
    renderer: SceneRenderer,
    cameras: dict[str, View],
    stops: dict[str, np.ndarray | None],
) -> dict[str, Any] | None:
    """PSNR, dB, and SSIM on the test photos as they were taken, of up to 1600 pixels a side, and
    `size`, width and height of most of them; None where none was undistorted or reduced.

    Args:    cameras: of the capture's views, by name; stops [3]: their photos' expected exposures.
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
        K, render = view.K.double().numpy(), renderer.render(view, stops=stops[name])[0]
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
