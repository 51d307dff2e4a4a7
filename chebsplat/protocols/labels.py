"""`labels` (ours): exact labels of generated and rendered scenes.

Split: the source's own, otherwise every 8th view from the first. Classes: the scene's own names; a label whose name is
no class is wrong wherever it is predicted. One confusion matrix over all test views: mIoU over classes that occur in
truth or prediction, mAcc over those in the truth, OA; mIoU within 5 pixels of a boundary; the same for the teacher.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from chebsplat.metrics import IGNORE, boundary_band, confusion, segmentation
from chebsplat.protocols.task import Seen, Task, translated

NAME = "labels"
TEST_EVERY, TEST_OFFSET, ADJUSTABLE, OWN_SPLIT, ON_TRAINING, TRUTH = 8, 0, True, True, False, "labels"


def measure(views: Iterable[Seen], task: Task) -> dict[str, Any]:
    """mIoU, mAcc, OA, IoU by class and within the boundary band: of the scene, and of its teacher on the same views."""
    n = len(task.classes)
    sums: dict[str, np.ndarray] = {}
    for view in views:
        assert view.truth is not None
        inside = np.where(boundary_band(view.truth, task.boundary), view.truth, IGNORE)
        for side, labels in (("scene", view.labels), ("teacher", view.teacher_labels)):
            if labels is not None:
                found = translated(labels, task.names, task.classes, n)
                counts = np.stack([confusion(found, truth, n + 1) for truth in (view.truth, inside)])
                sums[side] = sums.get(side, 0) + counts
    figures = {side: _figures(whole, edges, task.classes) for side, (whole, edges) in sums.items()}
    return {"classes": task.classes} | figures


def _figures(whole: np.ndarray, edges: np.ndarray, classes: list[str]) -> dict[str, Any]:
    found = segmentation(whole)

    def mean(values: np.ndarray) -> float | None:
        return None if np.isnan(values).all() else float(np.nanmean(values))

    return {
        "miou": mean(found.iou[:-1]),
        "macc": found.macc,
        "oa": found.oa,
        "boundary_miou": mean(segmentation(edges).iou[:-1]),
        "iou": {name: None if np.isnan(v) else float(v) for name, v in zip(classes, found.iou, strict=False)},
    }
