"""OpenSplat on the CPU beside ours: same photos, poses, points, seconds of training and cores:
those that this process may run on.

Build it first by opensplat.sh, which has the commands. It gets what `chebsplat extract` writes of a
scene, less the test views, and trains in two forms, of which the better counts: on its own schedule
of 30,000 steps, cut off, and on one of as many steps as those took; both at a quarter of the size,
as it starts by itself: a step at full size takes seconds. Both systems' test views are rendered and
measured by this project at full size, colour only, OpenSplat's with the principal point in the
middle, where its CPU rasterizer has every camera's, and under the best of three blurs: that of the
photos, and those of photos a half and a quarter of their size.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.ply import read_ply
from chebsplat.formats.points import Points
from chebsplat.formats.world import World
from chebsplat.render import SceneRenderer
from chebsplat.stages.measuring.image_quality import image_figures
from chebsplat.stages.tools.camera_files import write_capture
from chebsplat.views import View

SCENES = ("fox", "redkitchen", "office0", "kitchen")
ITERATIONS = 30_000  # OpenSplat's own
EVERY = 25  # steps between two files of it


def keep_training_views(capture: Capture, points: Points) -> Points:
    """Points, in place, with the registered views that are trained on alone."""
    test = {name for name, is_test in zip(capture.names, capture.is_test, strict=True) if is_test}
    kept = [view for view, name in enumerate(points.names) if name not in test]
    place = {view: k for k, view in enumerate(kept)}
    tracks = [(point, place[view]) for point, view in points.tracks.tolist() if view in place]
    points.names = [points.names[view] for view in kept]
    points.Ks, points.cam_from_world = points.Ks[kept], points.cam_from_world[kept]
    points.tracks = np.array(tracks, np.int32).reshape(-1, 2)
    return points


def train_opensplat(
    binary: Path, folder: Path, out: Path, seconds: float, steps: int
) -> tuple[Path, int]:
    """The last PLY that OpenSplat has written after so many seconds of steps, and its step.

    Args: steps: of its schedule, all made if they take no longer.
    """
    out.mkdir()
    command = [binary, folder, "-o", out / "splat.ply", "--keep-crs", "--cpu", "-n", steps]
    with subprocess.Popen(
        [*map(str, command), "--save-every", str(EVERY)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        ends = None
        for line in process.stdout:
            if ends is None and line.startswith("Step"):
                ends = time.monotonic() + seconds
            if ends is not None and time.monotonic() > ends:
                process.kill()
                break
    if process.returncode > 0:
        raise SystemExit(f"OpenSplat failed with exit code {process.returncode}")
    if (out / "splat.ply").exists():
        return out / "splat.ply", steps
    written = sorted(out.glob("splat_*.ply"), key=lambda path: int(path.stem.split("_")[1]))
    if len(written) < 2:  # the last may be half written
        raise SystemExit(f"OpenSplat made fewer than {2 * EVERY} steps; raise --seconds")
    last = written[-2]
    return last, int(last.stem.split("_")[1])


def as_opensplat_sees(cameras: Cameras) -> Cameras:
    """Cameras whose principal point is the middle of the image; photos are compared as rendered."""
    Ks = cameras.Ks.copy()
    Ks[:, 0, 2], Ks[:, 1, 2] = cameras.width / 2, cameras.height / 2
    return replace(cameras, Ks=Ks, exposures=None)


def measure_test_views(
    capture: Capture, cameras: Cameras, parameters: dict[str, np.ndarray], shrunk: int = 1
) -> dict[str, Any]:
    """PSNR and SSIM of the test views, which are among the cameras, in their exposures, if any.

    Args: shrunk: views are blurred as much as photos are that many times smaller.
    """
    row = {name: k for k, name in enumerate(capture.names)}
    renderer = SceneRenderer(parameters, "cpu", cameras.Ks / shrunk)
    views = [k for k, name in enumerate(cameras.names) if capture.is_test[row[name]]]
    renders = []
    for k in views:
        K, pose = (torch.from_numpy(m[k]).float() for m in (cameras.Ks, cameras.cam_from_world))
        view = View(K, pose, cameras.width, cameras.height)
        renders.append(renderer.render(view, stops=cameras.stops(k))[0])
    rows = [row[cameras.names[k]] for k in views]
    masks = None if capture.loss_mask is None else [capture.loss_mask[k] for k in rows]
    figures = image_figures(np.stack(renders), np.stack([capture.images[k] for k in rows]), masks)
    return {
        "psnr": round(figures["psnr"], 2),
        "ssim": round(figures["ssim"], 4),
        "n_gaussians": len(parameters["means"]),
    }


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("opensplat", __doc__)
    parser.add_argument("--binary", type=Path, required=True, help="built by opensplat.sh")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--seconds", type=float, default=120, help="of training")
    options = parser.parse_args(arguments)
    print(shared.machine(), flush=True)
    rows: list[dict[str, Any]] = []

    def add(scene: str, system: str, steps: int, figures: dict[str, Any]) -> None:
        rows.append({"scene": scene, "system": system, "steps": steps} | figures)
        print(" ".join(f"{value!s:>14}" for value in rows[-1].values()), flush=True)
        shared.write_csv(options.out / "opensplat.csv", rows)  # a later training may fail

    for scene in shared.there(options.scenes):
        settings = f"teacher.kind=none,train.seconds={options.seconds:g}"
        plan = shared.finished([(scene, settings)], "train")[0]
        artifacts = plan.targets
        capture, gaussians = Capture.read(artifacts["ingest"]), Gaussians.read(artifacts["train"])
        steps = int(gaussians.trace[-1]["step"])
        add(
            scene,
            "ours",
            steps,
            measure_test_views(capture, gaussians.cameras, gaussians.parameters),
        )
        with TemporaryDirectory() as place:
            folder = Path(place) / "capture"
            write_capture(
                folder, capture, keep_training_views(capture, Points.read(artifacts["sfm"]))
            )
            (folder / "transforms.json").unlink()  # it would be read, without the points
            steps = ITERATIONS
            for form in ("cut off", "of as many steps"):
                out = Path(place) / form.replace(" ", "-")
                ply, steps = train_opensplat(options.binary, folder, out, options.seconds, steps)
                parameters, degree, _ = read_ply(ply, World.read(capture.source))
                parameters["degrees"] = np.full(len(parameters["means"]), degree, np.uint8)
                cameras = as_opensplat_sees(gaussians.cameras)
                measured = [
                    measure_test_views(capture, cameras, parameters, shrunk) for shrunk in (1, 2, 4)
                ]
                best = max(measured, key=lambda figures: figures["psnr"])
                add(scene, f"OpenSplat, {form}", steps, best)
    return 0
