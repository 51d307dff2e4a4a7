"""`scannet-closed` (Panoptic Lifting): 21 reduced classes and void on ScanNet.

Split: that of splits.json, otherwise every 5th frame from the first. Truth: NYU's 40 classes
reduced to the 21 below, objects corrected by hand in nine scenes; void (0) is masked. Ids differ
from `scannet-open` in two places (10 is counter, 11 shelves), so labels are joined on names.
Resizing: labels to 512x512 by the nearest pixel, whatever the aspect; views keep theirs, at 592
pixels at most: of 4:3 as many pixels. Averaging: one confusion matrix a scene; a class with less
than 0.5 % of both the predicted and the true pixels is dropped; void counts as a class of IoU 0
where 0.5 % of the pixels are predicted void; mIoU of the rest; the mean over scenes (`averaged`) is
not weighted. The peers learn from pseudo labels of Mask2Former with a confidence by pixel, which
`teacher.kind = "given"` takes from the source; in the measure they play no part.
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
    predicted,
    required,
    resized,
    translated,
)

NAME = "scannet-closed"
RULE = Rule(side=592, test_every=5, own_split=True)
CLASSES = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "counter",
    "shelves", "curtain", "ceiling", "refrigerator", "television", "person", "toilet", "sink",
    "lamp", "bag", "otherprop",
)  # fmt: skip
VOID = "void"
_CLASS_OF = {  # by NYU40 id
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door",
    9: "window", 10: "shelves", 12: "counter", 14: "table", 15: "shelves", 16: "curtain",
    20: "floor", 22: "ceiling", 24: "refrigerator", 25: "television", 28: "curtain", 31: "person",
    33: "toilet", 34: "sink", 35: "lamp", 37: "bag",
}  # fmt: skip
REDUCED = (VOID, *(_CLASS_OF.get(nyu, "otherprop") for nyu in range(1, 41)))  # by NYU40 id
SIZE, RARE = (512, 512), 0.005


def measure(views: Iterable[EvaluatedView], task: Task) -> dict[str, Any]:
    """mIoU of one scene, IoU by class (None where dropped). Raises DataFailure on other labels."""
    required(task.names, CLASSES, NAME, also=(VOID,))
    classes = [VOID, *CLASSES]
    sums: dict[str, np.ndarray] = {}
    for view in views:
        assert view.truth is not None
        truth = resized(translated(view.truth, task.classes, classes, 0), SIZE, centred=True)
        for side, labels in (("scene", view.labels), ("teacher", view.teacher_labels)):
            if labels is not None:
                prediction = resized(predicted(labels, task.names, classes, 0), SIZE, centred=True)
                sums[side] = sums.get(side, 0) + confusion(
                    prediction, np.where(truth == 0, -1, truth), len(classes)
                )
    there = {"miou": counted(sums["scene"].sum(1)[1:])}
    return {"classes": list(CLASSES), "counted": there} | {
        side: figures(matrix) for side, matrix in sums.items()
    }


def figures(matrix: np.ndarray) -> dict[str, Any]:
    """Figures of one scene's confusion matrix [22, 22], rows by truth, void first."""
    n_right, n_true, n_predicted = np.diag(matrix).astype(float), matrix.sum(1), matrix.sum(0)
    frequent = np.maximum(n_true, n_predicted) >= RARE * max(matrix.sum(), 1)
    columns = zip(n_right, n_true, n_predicted, frequent, strict=True)
    values = [float(r / (t + f - r)) if counts else None for r, t, f, counts in columns]
    iou = dict(zip((VOID, *CLASSES), values, strict=True))
    miou = mean_over(np.array(list(iou.values()), float), n_true)
    return {"miou": miou, "macc": None, "oa": None, "boundary_miou": None, "iou": iou}


def over_scenes(scenes: list[dict[str, Any]]) -> dict[str, Any]:
    """mIoU of several scenes together, from the figures of each by `measure`."""
    return {"miou": averaged([scene["miou"] for scene in scenes])}


def averaged(values: list[float | None]) -> float | None:
    """Plain mean of the scenes' mIoU that were measured."""
    mious = [value for value in values if value is not None]
    return float(np.mean(mious)) if mious else None
