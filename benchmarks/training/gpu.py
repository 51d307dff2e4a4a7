"""office0 trained on a GPU, beside the CPU and beside plain 3DGS through gsplat.

Rows of gpu.csv: a training each, with its seconds, PSNR and mIoU on the test views, and the most
memory that tensors have taken until then; frames a second of our scene by this project's renderer
and of plain 3DGS by gsplat's own, by turns, the images copied back. Then the launches of a step, by
the profiler; one step of scenes of 20,000, 200,000 and 1,000,000 Gaussians, ours, and gsplat's own
with and without packing; one of large photos; and a short training twice: gsplat adds gradients up
in the order in which threads arrive.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from benchmarks.training import cost
from benchmarks.training.cost import trainer_from
from chebsplat.errors import ConfigError
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.scene import Scene
from chebsplat.pipelines.work.scenes import read_toml
from chebsplat.rasterize import rasterize
from chebsplat.render import SceneRenderer
from chebsplat.settings import TrainSection
from chebsplat.stages import evaluate, export, train
from chebsplat.stages.runtime.command import publish
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.runtime.device import resolve
from chebsplat.training.trainer import Trainer
from chebsplat.views import View

DEVICE, REPEATS = "cuda", 5
RUNS = {  # ablation, steps, device
    "GPU": ("", 1500, "cuda"),
    "GPU, twice the steps": ("", 3000, "cuda"),
    "CPU": ("", 1500, "cpu"),
    "plain 3DGS, GPU": ("plain", 1500, "cuda"),
}
STEPS = 300  # of the training that is repeated
SIZES = (20_000, 200_000, 1_000_000)
LARGE = (500_000, (1336, 1000), 200)  # Gaussians, pixels, views
WIDTH, HEIGHT, CHANNELS = 640, 480, 16
LAUNCHES = (
    "cudaLaunchKernel",
    "cuLaunchKernel",
    "cudaGraphLaunch",
    "cudaMemcpyAsync",
    "cudaMemsetAsync",
)
BARS = {"seconds": 15.0, "twice the steps": 30.0, "frames": 1.5, "launches": 60}


def main(arguments: Sequence[str]) -> int:
    options = shared.parser("gpu", __doc__, work=True).parse_args(arguments)
    try:
        resolve("cuda")
    except ConfigError as error:
        print(error)
        return 2
    rows: list[dict[str, Any]] = []

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        cells = (
            (key, f"{value:.5g}" if isinstance(value, float) else value)
            for key, value in row.items()
        )
        print("  ".join(f"{key} {value}" for key, value in cells), flush=True)
        shared.write_csv(options.out / "gpu.csv", rows)  # what was measured stays, whatever comes

    with tempfile.TemporaryDirectory() as folder:
        by_name = {}
        for name, (ablation, steps, device) in RUNS.items():
            by_name[name] = trained(
                options.work, Path(folder) / name, name, ablation, steps, device
            )
            add(by_name[name])
        on_gpu, longer, on_cpu, _ = (by_name[name] for name in RUNS)
        ours, plain = (
            Scene.read(Path(folder) / name / "export") for name in ("GPU", "plain 3DGS, GPU")
        )
        frames = by_turns({"ours": by_ours(ours), "plain": by_gsplat(plain)}, views_of(ours))
        add(frames)
        launched = launches(options.work)
        add(launched)
        for n in SIZES:
            for packed in (None, False, True):
                add(step(n, packed))
        if DEVICE == "cuda":
            add(large(options.work, Path(folder)))
        repeated = again(options.work)
        add(repeated)
    bars = {
        "PSNR as on the CPU, to 0.1 dB": abs(on_gpu["psnr"] - on_cpu["psnr"]) <= 0.1,
        "mIoU as on the CPU, to 0.5 points": abs(on_gpu["miou"] - on_cpu["miou"]) <= 0.005,
        f"1500 steps in {BARS['seconds']:g} s": on_gpu["seconds"] <= BARS["seconds"],
        f"3000 steps in {BARS['twice the steps']:g} s": longer["seconds"]
        <= BARS["twice the steps"],
        f"{BARS['launches']} launches a step": launched["launches"] <= BARS["launches"],
        f"{BARS['frames']} times plain 3DGS's frames": frames["ours"]
        >= BARS["frames"] * frames["plain"],
        "a training repeats to 0.1 dB": abs(repeated["psnr"] - repeated["psnr_before"]) <= 0.1,
    }
    for bar, holds in bars.items():
        print(f"{'holds' if holds else 'MISSED'}  {bar}")
    return 0 if all(bars.values()) else 1


def trained(
    work: Path, out: Path, name: str, ablation: str, steps: int, device: str
) -> dict[str, Any]:
    """A training's row, from a scene's teacher to its evaluation, in this process."""
    values = read_toml("ablations", ablation) if ablation else {}
    config = out.with_suffix(".json")
    config.write_text(json.dumps(values | {"train": values.get("train", {}) | {"steps": steps}}))
    features = (
        {} if values.get("train", {}).get("semantics") is False else {"features": work / "teacher"}
    )
    stages = (
        ("train", train.run, {"capture": work / "ingest", "points": work / "sfm"} | features),
        ("export", export.run, {"gaussians": out / "train"} | features),
        (
            "evaluate",
            evaluate.run,
            {"capture": work / "ingest", "scene": out / "export"} | features,
        ),
    )
    for stage, run, inputs in stages:
        publish(
            stage, run, out / stage, inputs, config, device="cpu" if stage == "export" else device
        )
    figures = json.loads((out / "evaluate" / "figures.json").read_text())
    facts = read_manifest(out / "train").facts
    segmentation = figures.get("segmentation")
    return {
        "what": name,
        "device": shared.processor() if device == "cpu" else torch.cuda.get_device_name(),
        "steps": steps,
        "seconds": facts["seconds_per_step"] * steps,
        "psnr": figures["image"]["psnr"],
        "miou": segmentation["scene"]["miou"] if segmentation else None,
        "gaussians": facts["n_gaussians"],
        "peak_bytes": facts.get("peak_device_bytes"),
    }


def views_of(scene: Scene) -> list[View]:
    cameras = scene.cameras
    return [
        View(
            torch.tensor(K).float().to(DEVICE),
            torch.tensor(pose).float().to(DEVICE),
            cameras.width,
            cameras.height,
        )
        for K, pose in zip(cameras.Ks, cameras.cam_from_world, strict=True)
    ]


def by_turns(
    renderers: dict[str, Callable[[View], np.ndarray]], views: list[View]
) -> dict[str, Any]:
    """Frames a second over all views by each renderer, the best of REPEATS rounds in turn."""
    seconds: dict[str, list[float]] = {name: [] for name in renderers}
    for _ in range(1 + REPEATS):  # the first loads
        for name, render in renderers.items():
            began = time.perf_counter()
            for view in views:
                render(view)
            seconds[name].append(time.perf_counter() - began)
    row = {"what": "frames a second", "device": torch.cuda.get_device_name()}
    return row | {name: len(views) / min(rounds[1:]) for name, rounds in seconds.items()}


def by_ours(scene: Scene) -> Callable[[View], np.ndarray]:
    renderer = SceneRenderer(scene.parameters, DEVICE)
    return lambda view: renderer.render(view)[0]


def by_gsplat(scene: Scene) -> Callable[[View], np.ndarray]:
    """A scene as gsplat itself renders it, all SH bands of all Gaussians."""
    import gsplat

    raw = {
        name: torch.from_numpy(np.ascontiguousarray(value)).to(DEVICE)
        for name, value in scene.parameters.items()
    }
    coefficients = torch.cat([raw["sh0"], raw["shN"]], 1)
    gaussians = (
        raw["means"],
        raw["quats"],
        raw["log_scales"].exp(),
        raw["logit_opacities"].sigmoid(),
        coefficients,
    )
    degree = round(coefficients.shape[1] ** 0.5) - 1

    @torch.no_grad()
    def render(view: View) -> np.ndarray:
        camera = view.viewmat[None], view.K[None], view.width, view.height
        image = gsplat.rasterization(*gaussians, *camera, sh_degree=degree, packed=False)[0][0]
        pixels: np.ndarray = (image.clamp(0, 1) * 255).round().byte().cpu().numpy()
        return pixels

    return render


def launches(work: Path) -> dict[str, Any]:
    """Launches of a step but gsplat's, milliseconds of it and of its kernels, after growth."""
    trainer = trainer_from(
        work, Config(train=TrainSection(steps=STEPS, densify_until=0.3)), device=DEVICE
    )
    steps = trainer.steps()
    n_steps = 8  # a round of what is taught and when
    while trainer.step < 0.7 * STEPS // n_steps * n_steps:
        next(steps)
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(n_steps):
        next(steps)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - began
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as profile:
        for _ in range(n_steps):
            next(steps)
        torch.cuda.synchronize()
    counts = {call.key: call.count / n_steps for call in profile.key_averages()}
    kernels = sum(call.self_device_time_total for call in profile.key_averages()) / n_steps
    own = launches_of_gsplat(trainer)
    return {
        "what": "launches of a step",
        "device": torch.cuda.get_device_name(),
        "launches": sum(count for key, count in counts.items() if key.startswith(LAUNCHES)) - own,
        "launches_of_gsplat": own,
        "graphs": sum(count for key, count in counts.items() if key.startswith("cudaGraphLaunch")),
        "waits": sum(count for key, count in counts.items() if "Synchronize" in key),
        "seconds": seconds / n_steps,
        "kernel_seconds": kernels * 1e-6,
        "gaussians": len(trainer.model),
    }


def launches_of_gsplat(trainer: Trainer) -> float:
    """Launches of gsplat's rasterization of the trainer's Gaussians alone, forward and backward."""
    raw = trainer.model.raw
    n, view = len(trainer.model), trainer.views.camera(0, 1)
    colors = torch.rand(n, 3 + raw["features"].shape[1] if "features" in raw else 3, device=DEVICE)
    leaves = [
        raw["means"],
        raw["quats"],
        raw["log_scales"].exp(),
        raw["logit_opacities"].sigmoid(),
        colors,
    ]
    leaves = [leaf.detach().requires_grad_(True) for leaf in leaves]
    camera = view.viewmat[None], view.K[None], view.width, view.height
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        image, alpha, _ = rasterize(*leaves, *camera, backend="cuda", harmless=True)
        torch.autograd.backward([image, alpha], [torch.ones_like(image), torch.ones_like(alpha)])
    # of ones
    return float(
        sum(call.count for call in profile.key_averages() if call.key.startswith(LAUNCHES)) - 2
    )


def step(n: int, packed: bool | None) -> dict[str, Any]:
    """Seconds and peak bytes of one rendering of n Gaussians at 640×480 in 16 channels, forward and
    backward.

    Args: packed: None renders as a training does; otherwise gsplat itself does, packed or not.
    """
    import gsplat

    generator = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=generator) * 4 - 2 + torch.tensor([0.0, 0.0, 4.0])
    sizes = [(n, 4), (n, 3), (n,), (n, CHANNELS)]
    quats, scales, opacities, colors = (torch.rand(size, generator=generator) for size in sizes)
    leaves = [means, quats + 0.1, 0.02 * scales + 0.002, 0.9 * opacities + 0.05, colors]
    leaves = [leaf.to(DEVICE).requires_grad_(True) for leaf in leaves]
    K = torch.tensor([[[500.0, 0, WIDTH / 2], [0, 500.0, HEIGHT / 2], [0, 0, 1]]], device=DEVICE)
    viewmats = torch.eye(4, device=DEVICE)[None]
    seconds = []
    for _ in range(1 + REPEATS):  # the first compiles, or loads
        torch.cuda.reset_peak_memory_stats()
        torch.cuda.synchronize()
        began = time.perf_counter()
        if packed is None:
            image, _, _ = rasterize(*leaves, viewmats, K, WIDTH, HEIGHT)
        else:
            image, _, _ = gsplat.rasterization(*leaves, viewmats, K, WIDTH, HEIGHT, packed=packed)
        image.square().mean().backward()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
    how = {None: "as trained", False: "gsplat, not packed", True: "gsplat, packed"}[packed]
    row = {
        "what": f"{n} Gaussians, forward and backward, {how}",
        "device": torch.cuda.get_device_name(),
        "gaussians": n,
    }
    return row | {
        "seconds": float(np.median(seconds[1:])),
        "peak_bytes": torch.cuda.max_memory_allocated(),
    }


def large(work: Path, folder: Path) -> dict[str, Any]:
    """A step of many Gaussians and large photos, and its memory: of `benchmarks cost --growth`."""
    n, size, n_views = LARGE
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    figures = cost.measured(cost.enlarged(work, size, n_views, folder / "large"), n, DEVICE)
    what = f"{n} Gaussians, {n_views} photos of {size[0]}×{size[1]}, a step"
    row = {"what": what, "device": torch.cuda.get_device_name(), "gaussians": n}
    return row | {
        "seconds": figures["step_ms"] / 1e3,
        "peak_bytes": round(figures["peak_gb"] * 2**30),
    }


def again(work: Path) -> dict[str, Any]:
    """PSNR of two trainings of STEPS steps on the GPU; same_bytes: both give the same bytes."""
    trainings = []
    for _ in range(2):
        trainer = trainer_from(work, Config(train=TrainSection(steps=STEPS)), device=DEVICE)
        for _ in trainer.steps():
            pass
        trainings.append(
            (trainer.held_in_psnr(list(range(0, len(trainer.views.names), 8))), trainer.finish())
        )
    (first, a), (second, b) = trainings
    same = all(np.array_equal(a[name], b[name]) for name in a)
    row = {
        "what": "the same training again",
        "device": torch.cuda.get_device_name(),
        "psnr": second,
    }
    return row | {"psnr_before": first, "same_bytes": same}
