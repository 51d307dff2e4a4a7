"""Run a benchmark, after the stages of its scene: python -m benchmarks NAME [ARGUMENTS].

With --work FOLDER among the arguments, a folder of a scene's links, that scene is measured as it
is.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

SCENE = "office0"


@dataclass(frozen=True)
class Benchmark:
    """module: in `benchmarks`; stages of SCENE that it needs, under `settings` as in `set=`."""

    module: str
    measures: str
    stages: tuple[str, ...] = ()
    settings: str = ""


BENCHMARKS = {
    "raster": Benchmark("raster", "the rasterizer against its bars: milliseconds, ratios"),
    "cost": Benchmark(
        "training.cost",
        "whole trainings beside plain 3DGS; --growth: by Gaussians, pixels, views",
        ("sfm", "teacher"),
    ),
    "descriptor": Benchmark(
        "descriptor", "the descriptor: regions a second, error, growth of sampling"
    ),
    "lift": Benchmark(
        "scenes.lift",
        "features lifted to a finished scene: seconds",
        ("train", "teacher"),
        "train.features=lifted",
    ),
    "refine": Benchmark(
        "scenes.refine",
        "error against run time of what follows a training: lift, smoothing, encoders",
        ("lift",),
    ),
    "trust": Benchmark(
        "teachers.trust",
        "whether views' agreement ranks 2D teachers as true mIoU does; no training",
    ),
    "sheets": Benchmark(
        "teachers.sheets", "pictures of modelled furniture and its rooms; nothing is measured"
    ),
    "mesh": Benchmark(
        "scenes.mesh",
        "the mesh against exact depth: F-score, labels, seconds by voxel",
        ("report",),
    ),
    "label": Benchmark(
        "scenes.label", "which Gaussians of a PLY are named right by shape alone; trains its scenes"
    ),
    "teaching": Benchmark(
        "teachers.teaching", "what the encoder of shape owes to transformers and descriptors"
    ),
    "lessons": Benchmark(
        "teachers.lessons", "what lessons of scenes, and labelled points, are worth in other scenes"
    ),
    "opensplat": Benchmark(
        "others.opensplat", "OpenSplat on the CPU beside ours at equal seconds; args=--binary FILE"
    ),
    "unposed": Benchmark(
        "scenes.unposed",
        "poses of photos that come alone, beside pycolmap's defaults; args=FOLDERS",
    ),
    "lenses": Benchmark(
        "scenes.lenses", "writes a dozen rendered captures with exact truth, for unposed"
    ),
    "query": Benchmark(
        "scenes.query",
        "asking at the suggested cut: precision, recall, absent words; trains 5 rooms",
    ),
    "gpu": Benchmark(
        "training.gpu",
        "a GPU beside the CPU: seconds, PSNR, mIoU, frames/s, launches, memory",
        ("sfm", "teacher"),
    ),
    "stability": Benchmark("stability.main", "every extreme case of the maths; fails if one does"),
}


def linked(benchmark: Benchmark) -> Path:
    """The folder of SCENE's links, its `stages` up to date. CalledProcessError if one fails."""
    command = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", "run", "--scene", SCENE]
    command += ["--set", benchmark.settings] if benchmark.settings else []
    for stage in benchmark.stages:
        subprocess.run([*command, "--stage", stage], check=True)
    work = Path(os.environ.get("CHEBSPLAT_WORK") or "work")
    return work / (f"{SCENE}@{benchmark.settings}" if benchmark.settings else SCENE)


def main(arguments: Sequence[str]) -> int:
    if not arguments:
        for name, benchmark in BENCHMARKS.items():
            needs = f" ({SCENE}: {', '.join(benchmark.stages)})" if benchmark.stages else ""
            print(f"{name:<11} {benchmark.measures}{needs}")
        return 0
    name, *rest = arguments
    if name not in BENCHMARKS:
        print(
            f"no benchmark is called {name[:60]!a}; there are {', '.join(BENCHMARKS)}",
            file=sys.stderr,
        )
        return 2
    benchmark = BENCHMARKS[name]
    if benchmark.stages and not any(
        text in ("-h", "--help") or text.startswith("--work") for text in rest
    ):
        try:
            rest = ["--work", str(linked(benchmark)), *rest]
        except subprocess.CalledProcessError as error:
            return error.returncode
    return int(import_module(f"benchmarks.{benchmark.module}").main(rest) or 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
