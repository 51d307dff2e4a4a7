"""`labels` (ours): exact labels of generated and rendered scenes.

Resolution: 640 pixels at most. Split: the source's own, otherwise every 8th view from the first.
Classes: the scene's own names; a label whose name is no class is wrong wherever it is predicted.
One confusion matrix over all test views: mIoU over classes that occur in truth or prediction, mAcc
over those in the truth, OA; mIoU within 5 pixels of a boundary, and over the five classes with the
fewest pixels; the same for the teacher. 3D point mIoU, from depth and poses of pixels: over points
of the test views' surfaces (40,000 pixels a view on a regular grid, of which one a cell is kept:
`metrics.thinned`), the scene's label is that of its Gaussians there, without rendering; where it
has none, it is wrong. The teacher's is the label of the pixel that the point comes from.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from chebsplat.evaluation.metrics import IGNORE, boundary_band, confusion, segmentation, thinned
from chebsplat.evaluation.protocols.task import (
    EvaluatedView,
    Rule,
    Task,
    counted,
    mean_over,
    predicted,
)
from chebsplat.labels.decode import decode_labels

RULE = Rule(adjustable=True, own_split=True)

N_RAREST = 5  # classes whose mean IoU is reported separately
PER_VIEW = 40_000  # pixels of a view that become points, about, on a regular grid


def measure(views: Iterable[EvaluatedView], task: Task) -> dict[str, Any]:
    """mIoU (of pixels, boundary pixels and points), mAcc, OA, IoU by class: of the scene, and of
    its teacher; and what each mIoU rests on (`task.counted`).
    """
    n = len(task.classes)
    sums: dict[str, np.ndarray] = {}
    # (position, truth, teacher's label) of a view's pixels with both
    points: list[tuple[np.ndarray, ...]] = []
    for view in views:
        assert view.truth is not None
        inside = np.where(boundary_band(view.truth, task.boundary), view.truth, IGNORE)
        for side, labels in (("scene", view.labels), ("teacher", view.teacher_labels)):
            if labels is not None:
                prediction = predicted(labels, task.names, task.classes, n)
                counts = np.stack(
                    [confusion(prediction, truth, n + 1) for truth in (view.truth, inside)]
                )
                sums[side] = sums.get(side, 0) + counts
        if view.surface is not None:
            step = max(round((view.truth.size / PER_VIEW) ** 0.5), 1)
            maps = (view.surface.astype(np.float32), view.truth, view.teacher_labels)
            positions, truth, *of_teacher = (
                of[step // 2 :: step, step // 2 :: step] for of in maps if of is not None
            )
            usable = (truth != IGNORE) & np.isfinite(positions).all(-1)
            points.append(tuple(of[usable] for of in (positions, truth, *of_teacher)))
    figures = {side: _figures(whole, edges, task.classes) for side, (whole, edges) in sums.items()}
    of_points, there = (
        _point_mious(points, task) if points and task.at is not None else ({}, np.zeros(n))
    )
    by_class, edge = (part.sum(1)[:-1] for part in sums["scene"])
    rests = {
        "miou": by_class,
        "boundary_miou": edge,
        "rarest_miou": by_class[rarest(by_class)],
        "point_miou": there,
    }
    return {
        "classes": task.classes,
        "counted": {name: counted(pixels) for name, pixels in rests.items()},
    } | {side: of_side | {"point_miou": of_points.get(side)} for side, of_side in figures.items()}


def _point_mious(
    points: list[tuple[np.ndarray, ...]], task: Task
) -> tuple[dict[str, float | None], np.ndarray]:
    """mIoU of scene and teacher over points of surfaces; how many of these are of each class."""
    assert task.at is not None
    positions, truth, *of_teacher = (np.concatenate(parts) for parts in zip(*points, strict=True))
    rows, n = thinned(positions), len(task.classes)
    features, weights = task.at(positions[rows])
    labels = predicted(decode_labels(features, task.embeddings), task.names, task.classes, n)
    sides = {"scene": np.where(weights > 0, labels, n)}
    if of_teacher:
        sides["teacher"] = predicted(of_teacher[0][rows], task.names, task.classes, n)
    there = np.bincount(truth[rows], minlength=n)
    ious = {
        side: segmentation(confusion(labels, truth[rows], n + 1)).iou
        for side, labels in sides.items()
    }
    return {side: mean_over(iou[:-1], there) for side, iou in ious.items()}, there


def rarest(pixels: np.ndarray) -> np.ndarray:
    """Indices of the N_RAREST classes with the fewest `pixels` of truth, but more than none."""
    return np.argsort(np.where(pixels > 0, pixels, np.inf), kind="stable")[
        : min(N_RAREST, int((pixels > 0).sum()))
    ]


def _figures(whole: np.ndarray, edges: np.ndarray, classes: list[str]) -> dict[str, Any]:
    scores, (pixels, edge) = segmentation(whole), (part.sum(1)[:-1] for part in (whole, edges))
    rare = rarest(pixels)
    return {
        "miou": mean_over(scores.iou[:-1], pixels),
        "macc": mean_over(np.array([scores.macc]), pixels),
        "oa": None if np.isnan(scores.oa) else scores.oa,
        "boundary_miou": mean_over(segmentation(edges).iou[:-1], edge),
        "rarest_miou": mean_over(scores.iou[rare], pixels[rare]),
        "iou": {
            name: None if np.isnan(v) else float(v)
            for name, v in zip(classes, scores.iou, strict=False)
        },
    }
