"""`replica-f3` (Feature 3DGS): agreement with the teacher's own labels, without ground truth.

Resolution: 640 pixels at most, as Semantic-NeRF's renders have. Split: index % 8 == 2 by name.
Feature 3DGS sorts its students as text and its teachers as numbers, so that unpadded names pair
different views; here views are joined on their names. Labels: the 150 names of ADE20K without a
prompt template; of ids that count from 1, television (90) becomes door (15), rug (29) floor (4),
pillow (58) cushion (40). Resizing: where a view is wider than 480 pixels, features of both become
480x360, bilinear with aligned corners, which distorts; labels then become 159x119 by the nearest
pixel. Averaging: by image, mean IoU over the 7 labels that are most frequent in teacher and student
together, and pixel accuracy; then the mean over images. Labels of equal frequency are taken in the
order of their ids; Feature 3DGS leaves that open.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from chebsplat.errors import DataFailure
from chebsplat.evaluation.protocols.task import (
    EvaluatedView,
    Rule,
    Task,
    bilinear,
    counted,
    mean_over,
    resized,
)
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.names import folded

RULE = Rule(test_offset=2, truth="teacher")
N_LABELS, N_COUNTED = 150, 7
MERGED = {90: 15, 29: 4, 58: 40}  # ids from 1
SPELT = {4: "floor", 15: "door", 29: "rug", 40: "cushion", 58: "pillow", 90: "television"}
FEATURES, LABELS = (360, 480), (119, 159)  # (H, W)


def measure(views: Iterable[EvaluatedView], task: Task) -> dict[str, Any]:
    """Agreement of the scene with its teacher: mean over images of mIoU and OA; `iou` by label,
    over its images.

    Raises: DataFailure unless the teacher's labels are ADE20K's, and without a teacher.
    """
    names = [folded(name) for name in task.names]
    wrong = [
        k
        for k, name in SPELT.items()
        if len(names) != N_LABELS or not names[k - 1].startswith(name)
    ]
    if wrong:
        raise DataFailure(
            f"the protocol asks for the 150 labels of ADE20K in their order (label {wrong[0]}: "
            f"{SPELT[wrong[0]]}); the teacher has {len(task.names)}; give it these, or use "
            "another protocol"
        )
    rows: list[tuple[float, float]] = []  # (mIoU, OA) of each image
    by_label: dict[int, list[float]] = {k: [] for k in range(1, N_LABELS + 1)}
    of_teacher = np.zeros(N_LABELS + 1, int)
    for view in views:
        if view.teacher is None:
            raise DataFailure(
                f"view {view.name} has no features of a teacher, which the protocol compares with"
            )
        student, teacher = (
            _labels(f, view, task.embeddings) for f in (view.features, view.teacher)
        )
        ious = frequent_ious(student, teacher)
        rows.append((float(np.mean(list(ious.values()))), float(np.mean(student == teacher))))
        of_teacher += np.bincount(teacher.ravel(), minlength=N_LABELS + 1)
        for k, value in ious.items():
            by_label[k].append(value)
    miou, oa = np.mean(rows, 0)
    iou = {
        name: float(np.mean(by_label[k])) if by_label[k] else None
        for k, name in enumerate(task.names, 1)
    }
    there = {"miou": counted(of_teacher)}
    scene = {
        "miou": mean_over(miou, of_teacher),
        "macc": None,
        "oa": float(oa),
        "boundary_miou": None,
        "iou": iou,
    }
    return {"classes": task.names, "counted": there, "scene": scene}


def _labels(features: np.ndarray, view: EvaluatedView, embeddings: np.ndarray) -> np.ndarray:
    """Merged ids from 1, [119, 159]."""
    if view.labels.shape[1] > FEATURES[1]:
        features = bilinear(features, FEATURES)
    return resized(merged(decode_labels(features, embeddings) + 1), LABELS)


def merged(ids: np.ndarray) -> np.ndarray:
    """Ids from 1 with the merges applied, in any order: no target is merged itself."""
    table = np.arange(N_LABELS + 1)
    table[list(MERGED)] = list(MERGED.values())
    result: np.ndarray = table[ids]
    return result


def frequent_ious(student: np.ndarray, teacher: np.ndarray) -> dict[int, float]:
    """IoU of the N_COUNTED ids that are most frequent in both images together."""
    ids, counts = np.unique(np.concatenate([student, teacher], None), return_counts=True)
    frequent = ids[np.argsort(-counts, kind="stable")][:N_COUNTED]
    masks = {int(k): (student == k, teacher == k) for k in frequent}
    return {
        k: float(np.sum(ours & theirs) / np.sum(ours | theirs))
        for k, (ours, theirs) in masks.items()
    }
