"""Photos that come alone: the stage `pose` beside pycolmap's defaults on the same files.

Errors are in units of the photo's longer side. A folder with a `truth.json`, which maps a photo's
stem to its camera-to-world matrix in metres, is held against it, too: medians of the angle and of
the distance after a similarity.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pycolmap

from benchmarks import shared
from chebsplat.cameras import centers
from chebsplat.errors import ChebsplatError
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.pipelines.api import run_stage
from chebsplat.stages.reconstruction.adjustment import alignment, differences

ROUNDS = 20  # of fits to the better half
FAR = 0.1  # metres: a photo that misses its place by more is misplaced


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("unposed", __doc__)
    parser.add_argument(
        "captures", type=Path, nargs="+", help="folders of photos, each with its photos in images/"
    )
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    print(shared.machine())
    print(
        "| capture | photos | registered | theirs | points | theirs | error | theirs | seconds "
        "| theirs | truth |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for folder in options.captures:
        photos = folder / "images"
        with TemporaryDirectory() as scratch:
            theirs, their_seconds = defaults(photos, Path(scratch), options.threads)
            began = time.perf_counter()
            try:
                model = PhotoModel.read(run_stage(
                    "pose", Path(scratch) / "model", source={"kind": "photos", "path": str(photos)}
                ))  # fmt: skip
            except ChebsplatError as error:
                print(
                    f"| {folder.name} | {len(os.listdir(photos))} | refused | {theirs['n']} | | "
                    f"{theirs['points']} | | {theirs.get('error', np.nan):.2e} | "
                    f"{time.perf_counter() - began:.0f} | {their_seconds:.0f} | |\n  {error}",
                    flush=True,
                )
                continue
            seconds, facts = time.perf_counter() - began, model.judged
            print(
                f"| {folder.name} | {facts['n_given']} | {facts['n_registered']} | "
                f"{theirs.get('n')} | {facts['n_points']} | {theirs.get('points')} | "
                f"{facts['reprojection_error']:.2e} | {theirs.get('error', np.nan):.2e} | "
                f"{seconds:.0f} | {their_seconds:.0f} | {against(model, folder / 'truth.json')} |",
                flush=True,
            )
            for doubt in facts["doubts"]:
                print(f"  {doubt}", flush=True)
    return 0


def defaults(photos: Path, place: Path, threads: int) -> tuple[dict[str, Any], float]:
    """Photos, points, error of the largest model by pycolmap's defaults, one SIMPLE_RADIAL."""
    pycolmap.logging.minloglevel = 2
    began, database = time.perf_counter(), place / "theirs.db"
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = threads
    pycolmap.extract_features(
        database, photos, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
    )
    pycolmap.match_exhaustive(database, matching)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    (place / "theirs").mkdir()
    models = pycolmap.incremental_mapping(database, photos, place / "theirs", options)
    seconds = time.perf_counter() - began
    if not models:
        return {"n": 0, "points": 0}, seconds
    best = max(models.values(), key=lambda model: model.num_reg_images())
    side = max(max(camera.width, camera.height) for camera in best.cameras.values())
    return {
        "n": best.num_reg_images(),
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error() / side,
    }, seconds


def against(model: PhotoModel, path: Path) -> str:
    """Medians of the errors of a model's poses, and the number of errors beyond FAR.

    Choices: after the similarity that fits the half that it fits best, so that misplaced photos
      move no other.
    """
    if not path.exists():
        return "-"
    truth = {name: np.linalg.inv(pose) for name, pose in json.loads(path.read_text()).items()}
    exact, poses = np.stack([truth[name] for name in model.names]), model.cam_from_world
    near = np.ones(len(exact), bool)
    for _ in range(ROUNDS):
        scale, rotation, shift = alignment(poses[near], exact[near])
        aligned = poses.copy()
        aligned[:, :3, :3] = poses[:, :3, :3] @ rotation.T
        places = scale * centers(poses) @ rotation.T + shift
        aligned[:, :3, 3] = -np.einsum("vij,vj->vi", aligned[:, :3, :3], places)
        moved, turned = differences(aligned, exact)
        near = moved <= np.median(moved)
    return (
        f"{np.degrees(np.median(turned)):.2f}°, {100 * np.median(moved):.1f} cm, "
        f"{(moved > FAR).sum()} misplaced"
    )
