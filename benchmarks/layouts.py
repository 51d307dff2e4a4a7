"""What every exported layout of a trained scene costs, and what it loses: bytes, and images beside the checkpoint's.

Each layout is read back (the compressed ones through npm's splat-transform, which also writes them) and rendered in
every test view, all bands, in float32. Bars: split and ragged take at most 40 % of the unpruned PLY, and
no pixel of ours is off by more than 1e-4.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks import shared
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import read_capture
from chebsplat.formats.gaussians import read_gaussians
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import read_scene
from chebsplat.rasterize import rasterize
from chebsplat.splats.gaussians import activated
from chebsplat.splats.sh import eval_sh
from chebsplat.stages.evaluate import camera
from chebsplat.views import View

Parameters = dict[str, np.ndarray]
CONVERT = ["npx", "--yes", "@playcanvas/splat-transform@2.7.1", "--quiet", "--overwrite"]
LARGEST_SHARE, LARGEST_ERROR = 0.4, 1e-4


def rendered(parameters: Parameters, views: list[View]) -> np.ndarray:
    """Float images [V, H, W, 3] of raw parameters; `shN` zero above a Gaussian's degree."""
    raw = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in parameters.items()}
    means, quats, scales, opacities = activated(raw)
    images = []
    for view in views:
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        colors = eval_sh(raw["sh0"], raw["shN"], means - eye, 3)
        gaussians = (means, quats, scales, opacities, colors)
        images.append(rasterize(*gaussians, view.viewmat[None], view.K[None], view.width, view.height)[0][0].numpy())
    return np.stack(images)


def ours(folder: Path) -> Iterator[tuple[str, int, Parameters]]:
    """(layout, bytes, parameters) of what export writes, through our own readers."""
    scene = read_scene(folder)
    sizes = scene.summary["bytes"]
    yield "scene.ply", sizes["ply"], read_ply(folder / "scene.ply")[0]
    if parts := [read_ply(file)[0] for file in sorted(folder.glob("scene_d*.ply"))]:
        yield "split by degree", sizes["split"], {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    yield "ragged", sizes["ragged"], scene.parameters


def compressed(ply: Path, folder: Path) -> Iterator[tuple[str, int, Parameters]]:
    """As `ours`, of the compressed PLY and SPZ that the README's commands make; the same tool turns them back."""
    for name, options in {"compressed.ply": [], "spz": ["--spz-version", "3"]}.items():
        file, back = folder / f"scene.{name}", folder / "back.ply"
        for arguments in ([*options, str(ply), str(file)], [str(file), str(back)]):
            subprocess.run([*CONVERT, *arguments], check=True, capture_output=True)
        yield name, file.stat().st_size, read_ply(back)[0]


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("layouts", __doc__, work=True)
    options = parser.parse_args(arguments)
    work, out = options.work, options.out
    out.mkdir(parents=True, exist_ok=True)
    checkpoint, scene, capture = (
        read(work / stage)
        for read, stage in ((read_gaussians, "train"), (read_scene, "export"), (read_capture, "ingest"))
    )
    tests = {name for name, is_test in zip(capture.names, capture.is_test, strict=True) if is_test}
    views = [camera(scene, k) for k, name in enumerate(scene.cameras.names) if name in tests]
    wanted, unpruned = rendered(checkpoint.parameters, views), scene.summary["bytes"]["unpruned_ply"]
    layouts = list(ours(work / "export"))
    if shutil.which("npx"):
        layouts += compressed(work / "export/scene.ply", out)
    else:
        print("npx is not installed: no compressed layouts", file=sys.stderr)
    rows = [["layout", "bytes", "share of the unpruned PLY", "largest error of a pixel", "PSNR to the checkpoint, dB"]]
    good = True
    for name, size, parameters in layouts:
        error = rendered(parameters, views) - wanted
        psnr = -10 * np.log10(max(float(np.mean(error.astype(np.float64) ** 2)), 1e-20))
        rows.append([name, f"{size:,}", f"{size / unpruned:.1%}", f"{np.abs(error).max():.1e}", f"{psnr:.1f}"])
        good &= name not in ("split by degree", "ragged") or size <= LARGEST_SHARE * unpruned
        good &= name in ("compressed.ply", "spz") or np.abs(error).max() <= LARGEST_ERROR
    with (out / "layouts.csv").open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)
    for row in rows:
        print("  ".join(f"{cell:>26s}" for cell in row))
    key = read_manifest(work / "export").key
    print(f"export {key}: {'within' if good else 'NOT within'} the bars ({len(views)} test views)")
    return 0 if good else 1
