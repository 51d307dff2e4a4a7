"""Rank correlation of views' agreement and true mIoU of 2D teachers: scenes x teachers.

Every pair runs up to the stage `agree`, whose figure knows no true labels. Beside it stands the
mIoU of the teacher's own label maps against the true labels of all views, over the classes that
occur in either. Teachers: the embedded one, which has seen generated rooms and not the houses, and
the source's labels with a share of the segments confused. The houses need the test data
(CHEBSPLAT_TEST_DATA), and are left out with a line where it is not there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks import shared
from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.evaluation.protocols.task import predicted, resized
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import ViewAgreement
from chebsplat.formats.features import Features
from chebsplat.stages.settings import AgreeSection

SCENES = ("office0", "room0", "shuffled0", "kitchen", "living")
TEACHERS = {"embedded": ""} | {
    f"labels, {p:.0%} confused": f"teacher.kind=labels,teacher.confusion={p}"
    for p in (0.1, 0.3, 0.5, 0.7)
}
BAR, LEAST = 0.8, 12  # rank correlation, and pairs that it needs


def true_miou(artifacts: Mapping[str, Path]) -> float:
    """mIoU of a teacher's labels of all views, at their resolution; artifacts by stage."""
    capture, features = Capture.read(artifacts["ingest"]), Features.read(artifacts["teacher"])
    assert capture.labels is not None and capture.class_names and features.pseudo_labels is not None
    row, n = {name: k for k, name in enumerate(features.names)}, len(capture.class_names)
    counts = np.zeros((n + 1, n + 1), np.int64)
    for view, name in enumerate(capture.names):
        truth = capture.labels[view]
        prediction = resized(features.pseudo_labels[row[name]], truth.shape)
        counts += confusion(
            predicted(prediction, features.label_names, capture.class_names, n), truth, n + 1
        )
    return float(np.nanmean(segmentation(counts).iou[:-1]))


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("trust", __doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    options = parser.parse_args(arguments)
    pairs = list(product(shared.there(options.scenes), TEACHERS))
    plans = shared.finished([(scene, TEACHERS[teacher]) for scene, teacher in pairs], "agree")
    rows = []
    for (scene, teacher), plan in zip(pairs, plans, strict=True):
        measured, miou = ViewAgreement.read(plan.targets["agree"]), true_miou(plan.targets)
        value = measured.agreement or 0.0
        rows.append(
            {
                "scene": scene,
                "teacher": teacher,
                "agreement": value,
                "miou": miou,
                "points": measured.n_points,
            }
        )
        print(f"{scene:<10} {teacher:<22} agreement {value:.3f}  true mIoU {miou:.1%}")
    shared.write_csv(options.out / "trust.csv", rows)
    agreements, mious = (np.array([row[key] for row in rows]) for key in ("agreement", "miou"))
    rank = float(spearmanr(agreements, mious)[0]) if len(rows) > 2 else 0.0
    low = AgreeSection().low
    for side, which in (("below", agreements < low), ("above", agreements >= low)):
        if which.any():
            print(
                f"{side} {low:g}, where a scene {'warns' if side == 'below' else 'does not'}: "
                f"{which.sum()} pairs, mIoU {mious[which].min():.1%} to {mious[which].max():.1%}"
            )
    bars = [("pairs", len(rows), ">=", LEAST), ("rank correlation", rank, ">=", BAR)]
    return int(not all(shared.judged(bars)))
