"""`scannet-open` (Semantic Gaussians): open vocabulary on ScanNet, measured on training cameras.

12 scenes. Split: no view is held out, and every view is evaluated. Truth: `label-filt` through
column `cocomapid`; 0 is ignored. Classes: the 20 below in this order; ids differ from
`scannet-closed` in two places (10 is shelves, 11 counter), so labels are joined on names, never on
ids. A leading prompt "other" is dropped before the largest cosine is taken: no pixel can be
"other". Resizing: views are 648 pixels wide at most; predictions and truth are compared at 648x484,
nearest pixel. Averaging: ONE confusion matrix summed over all scenes (`summed`); a class that is
absent from the truth is skipped, even where it is predicted; mIoU and mAcc. A scene's own figures
are those of its matrix.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from chebsplat.evaluation.metrics import confusion
from chebsplat.evaluation.protocols.task import (
    EvaluatedView,
    Rule,
    Task,
    counted,
    mean_over,
    required,
    resized,
    translated,
)
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.names import joined

NAME = "scannet-open"
RULE = Rule(side=648, test_every=1, on_training=True)
CLASSES = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "shelves",
    "counter", "curtain", "ceiling", "refrigerator", "television", "person", "toilet", "sink",
    "lamp", "bag",
)  # fmt: skip
OTHER = "other"
SIZE = (484, 648)  # (H, W)


def measure(views: Iterable[EvaluatedView], task: Task) -> dict[str, Any]:
    """Figures of one scene and its `confusion` [20, 20] by truth, to sum. Raises DataFailure."""
    required(task.names, CLASSES, NAME, also=(OTHER,))
    rows = [k for k, name in enumerate(task.names) if joined(name) != OTHER]
    names, embeddings = [task.names[k] for k in rows], task.embeddings[rows]
    classes = list(CLASSES)
    sums: dict[str, np.ndarray] = {}
    for view in views:
        assert view.truth is not None
        truth = resized(translated(view.truth, task.classes, classes, -1), SIZE, centred=True)
        sides = {"scene": view.features} | (
            {} if view.teacher is None else {"teacher": view.teacher}
        )
        for side, features in sides.items():
            labels = translated(decode_labels(features, embeddings), names, classes, -1)
            prediction = resized(labels, SIZE, centred=True)
            sums[side] = sums.get(side, 0) + confusion(prediction, truth, len(classes))
    there = {"miou": counted(sums["scene"].sum(1))}
    return {"classes": classes, "counted": there} | {
        side: summed([matrix]) for side, matrix in sums.items()
    }


def over_scenes(scenes: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of several scenes together, from those of each by `measure`."""
    return summed([np.array(scene["confusion"]) for scene in scenes])


def summed(matrices: list[np.ndarray]) -> dict[str, Any]:
    """Figures of confusion matrices [20, 20] of several scenes, rows by truth, summed first."""
    matrix = np.sum(matrices, axis=0)
    right, truth = np.diag(matrix).astype(float), matrix.sum(1)
    present = truth > 0
    iou = right[present] / (truth + matrix.sum(0) - right)[present]
    mean = {
        "miou": mean_over(iou, truth),
        "macc": mean_over(right[present] / truth[present], truth),
    }
    by_class = dict(zip(np.array(CLASSES)[present].tolist(), iou.tolist(), strict=True))
    return mean | {
        "oa": float(right.sum() / matrix.sum()) if present.any() else None,
        "boundary_miou": None,
        "iou": {name: by_class.get(name) for name in CLASSES},
        "confusion": matrix.tolist(),
    }  # fmt: skip
