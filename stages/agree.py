"""agree: how far views agree on what the same points are; a teacher that does not know a scene is
found early.
"""

from __future__ import annotations

import logging

import numpy as np

from chebsplat.cameras import centers
from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import ViewAgreement
from chebsplat.formats.features import Features
from chebsplat.formats.points import Points
from chebsplat.labels.agreement import UNSEEN, between, far_pairs, project, unhidden
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.scores import UNSURE, sureness
from chebsplat.stages.reconstruction.thinning import even
from chebsplat.stages.runtime.command import Job

log = logging.getLogger("chebsplat")
SEED = 0  # of the choice among points
AGREED = 0.3  # agreement that no teacher has by chance


def run(job: Job) -> None:
    """The training views' agreement on the same points, without true labels (docs/method.md,
    section 9).

    Reads `capture`, `points` and `features`. Writes `agreement`.
    """
    settings, capture = job.config.agree, Capture.read(job.inputs["capture"])
    points, features = Points.read(job.inputs["points"]), Features.read(job.inputs["features"])
    views = training_views(capture, points, features)
    rows = even(points)
    rng = np.random.default_rng(SEED)
    chosen = np.sort(rng.choice(rows, min(settings.n_points, len(rows)), replace=False))
    said = labels_of(job, capture, points, features, views, chosen)
    eyes = centers(points.cam_from_world)[[place for _, place, _ in views]]
    row, first, second = far_pairs(points.means[chosen], eyes, said >= 0).T
    names = features.label_names
    found = between(said[row, first], said[row, second], len(names))
    value = float(found.value) if len(row) else None
    labels = {
        name: {"share": float(share), "agreement": float(of_label)}
        for name, share, of_label in zip(names, found.share, found.by_label, strict=True)
        if share > 0
    }
    job.facts |= {
        "agreement": value,
        "n_points": len(row),
        "n_views": len(views),
        "n_labels": len(labels),
    }
    if value is None:
        log.warning("no point has a label in two views: how far they agree is not known")
    elif value >= AGREED and (sure := sure_of(features, [at for _, _, at in views])) < UNSURE:
        job.facts["doubt"] = (
            f"views agree by {value:.2f} on what points are (1: always, 0: by chance), and the "
            "teacher is sure by "
            f"{sure:.2f} only: its outputs are flat, as of a softmax taken twice, of logits that "
            "were scaled down, or "
            "of photos in another range than it was trained on; `chebsplat check-teacher` tries "
            "the usual ones"
        )
        log.warning("%s", job.facts["doubt"])
    elif value < settings.low:
        job.facts["doubt"] = (
            f"views agree by {value:.2f} on what points are (1: always, 0: by chance), below "
            f"{settings.low:g}: the 2D "
            "teacher does not know this scene; name another (docs/teachers.md), or "
            "teacher.kind=none for colour alone"
        )
        log.warning("%s", job.facts["doubt"])
    else:
        log.info("views agree by %.2f on what points are (1: always, 0: by chance)", value)
    ViewAgreement(value, len(row), len(views), labels).write(job.out)


def sure_of(features: Features, views: list[int]) -> float:
    """How sure a segmenter is of its likeliest class; 1 of others, whose cosines do not tell."""
    if features.convention.get("output") != "logits" or features.confidence is None:
        return 1.0
    mean = np.mean([np.asarray(features.confidence[view], np.float32).mean() for view in views])
    return sureness(float(mean), len(features.label_names))


def training_views(
    capture: Capture, points: Points, features: Features
) -> list[tuple[int, int, int]]:
    """Where each training view with a pose stands in capture, points and features. Raises
    InputError, DataFailure.
    """
    row, taught = (
        {name: k for k, name in enumerate(names)} for names in (capture.names, features.names)
    )
    if unknown := [name for name in points.names if name not in row or name not in taught]:
        raise InputError(
            f"the points have a view {unknown[0]} that capture or features lack; "
            "pass those of one scene"
        )
    found = [
        (row[name], k, taught[name])
        for k, name in enumerate(points.names)
        if not capture.is_test[row[name]]
    ]
    if not found:
        raise DataFailure(
            "no training view has a camera; lower ingest.test_every's share of test views"
        )
    return found


def labels_of(
    job: Job,
    capture: Capture,
    points: Points,
    features: Features,
    views: list[tuple[int, int, int]],
    chosen: np.ndarray,
) -> np.ndarray:
    """The label that each view says of each chosen point, i64 [N, V]; -1 where the view does not
    see it.

    Choices: what hides a point is told by depth, where the capture has it in the frame of the
      points; by the tracks of structure from motion, whose points were found in the views that see
      them; otherwise by nearer points.
    """
    means, size = points.means.astype(np.float64), capture.size
    depths = capture.depth if capture.cam_from_world is not None else None
    number_of = np.full(len(means), -1)
    number_of[chosen] = np.arange(len(chosen))
    # the last row: of points that are not chosen
    found_in = np.zeros((len(chosen) + 1, len(points.names)), bool)
    found_in[number_of[points.tracks[:, 0]], points.tracks[:, 1]] = True
    said = np.full((len(chosen), len(views)), UNSEEN, np.int64)
    for (number, (row, place, taught)), _ in job.progress.track(
        enumerate(views), len(views), "agree"
    ):
        image = project(means, points.Ks[place], points.cam_from_world[place], size)
        if depths is not None:
            seen = unhidden(image, size, depths[row])[chosen]
        elif len(points.tracks):
            seen = np.isfinite(image[chosen, 0]) & found_in[:-1, place]
        else:
            seen = unhidden(image, size)[chosen]
        columns, rows = image[chosen[seen], :2].astype(np.int64).T
        if features.pseudo_labels is None:
            labels = decode_labels(
                features.features[taught].astype(np.float32), features.label_embeddings
            )
        else:
            labels = features.pseudo_labels[taught]
        height, width = labels.shape
        of_points = labels[rows * height // size[1], columns * width // size[0]].astype(np.int64)
        if capture.loss_mask is not None:
            of_points[~capture.loss_mask[row][rows, columns]] = UNSEEN
        said[seen, number] = of_points
    return said
