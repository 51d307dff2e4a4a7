"""Labels of a splat's Gaussians by shape and knowledge alone: scenes new to knowledge, as PLY.

Every scene is trained as it comes (as `query` trains it), once a seed, and only its PLY, without
features, is named as `chebsplat label` names it: told which way is up and what a metre is, shown no
photo. The truth of a Gaussian is what the true labels of all views say of it, lifted with the
weights that it is rendered with. The houses need the test data (CHEBSPLAT_TEST_DATA), and are left
out without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.formats.capture import Capture
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import SHIPPED
from chebsplat.formats.ply import write_ply
from chebsplat.lifting.observations import to_cells
from chebsplat.rasterize.lift import lift
from chebsplat.splats.gaussians import activated
from chebsplat.stages.shape_models.surfaces import up_of
from chebsplat.stages.tools.lift_ply import label_ply

# and what is asked of each
SCENES = {"office0": 0.8, "room0": 0.8, "shuffled0": 0.8, "shuffled1": 0.8, "kitchen": 0.6}


def true_labels(artifacts: Mapping[str, Path], gaussians: Gaussians) -> np.ndarray:
    """Label [N] of most of what shows a Gaussian, over all views; -1: none. Artifacts by stage."""
    capture, cameras = Capture.read(artifacts["ingest"]), gaussians.cameras
    assert capture.labels is not None and capture.class_names
    raw = {name: torch.from_numpy(values) for name, values in gaussians.parameters.items()}
    shapes = tuple(part.numpy() for part in activated(raw))
    n, row = len(capture.class_names), {name: k for k, name in enumerate(capture.names)}
    votes = np.zeros((len(shapes[0]), n))
    size = cameras.width, cameras.height
    for name, pose, K in zip(cameras.names, cameras.cam_from_world, cameras.Ks, strict=True):
        labels = capture.labels[row[name]]
        cells = to_cells(
            np.eye(n, dtype=np.float32)[labels.clip(0)], (labels >= 0).astype(np.float32), size
        )
        lifted = lift(shapes, pose, K, size, *cells)
        votes[lifted.ids] += lifted.sums
    return np.where(votes.any(1), votes.argmax(1), -1)


def named(artifacts: Mapping[str, Path]) -> dict[str, Any]:
    """Shares of a scene's Gaussians, and of the surer half, with their true label; the mIoU."""
    gaussians, capture = Gaussians.read(artifacts["train"]), Capture.read(artifacts["ingest"])
    assert capture.class_names
    truth, words = true_labels(artifacts, gaussians), list(capture.class_names)
    with TemporaryDirectory() as folder:
        ply, out = Path(folder) / "scene.ply", Path(folder) / "named.ply"
        write_ply(ply, gaussians.parameters, 3)
        up, _ = up_of(gaussians.cameras.cam_from_world)
        label_ply(ply, SHIPPED, words, up, 1.0, out)
        with np.load(out.with_suffix(".npz")) as stored:
            labels, sure = stored["labels"], stored["confidence"]
    labelled = truth >= 0
    right = (labels == truth)[labelled]
    surer = sure[labelled] >= np.median(sure[labelled])
    counts = confusion(labels[labelled], truth[labelled], len(words))
    return {
        "gaussians": int(labelled.sum()),
        "oa": float(right.mean()),
        "oa_surer_half": float(right[surer].mean()),
        "miou": float(np.nanmean(segmentation(counts).iou)),
    }


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("label", __doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--steps", type=int, default=1000, help="of the trainings")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of the trainings")
    options = parser.parse_args(arguments)
    pairs = list(product(shared.there(options.scenes), options.seeds))
    steps = f"train.steps={options.steps}"
    runs = [(scene, steps + (f",train.seed={seed}" if seed else "")) for scene, seed in pairs]
    rows = []
    for (scene, seed), plan in zip(pairs, shared.finished(runs, "train"), strict=True):
        rows.append(
            {"scene": scene, "seed": seed, **named(plan.targets), "bar": SCENES.get(scene, 0.0)}
        )
        line = (
            "{scene:<10} seed {seed}: {gaussians} Gaussians, {oa:.1%} named right, of the surer "
            "half {oa_surer_half:.1%}, mIoU {miou:.1%}"
        )
        print(line.format(**rows[-1]), flush=True)
    shared.write_csv(options.out / "label.csv", rows)
    means = {
        scene: float(np.mean([row["oa"] for row in rows if row["scene"] == scene]))
        for scene, _ in pairs
    }
    bars = [(f"{s}, named right", mean, ">=", SCENES.get(s, 0.0)) for s, mean in means.items()]
    return int(not all(shared.judged(bars)))
