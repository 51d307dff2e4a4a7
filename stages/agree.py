"""agree: agreement of views on the labels of the same points, an early check of the teacher."""

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
    """Agreement of the training views on labels of the same points (docs/method.md, section 9).

    Reads `capture`, `points` and `features`. Writes `agreement`.
    """
    settings, capture = job.config.agree, Capture.read(job.inputs["capture"])
    points, features = Points.read(job.inputs["points"]), Features.read(job.inputs["features"])
    views = training_views(capture, points, features)
    rows = even(points)
    rng = np.random.default_rng(SEED)
    sample = np.sort(rng.choice(rows, min(settings.n_points, len(rows)), replace=False))
    votes = labels_of(job, capture, points, features, views, sample)
    eyes = centers(points.cam_from_world)[[place for _, place, _ in views]]
    row, first, second = far_pairs(points.means[sample], eyes, votes >= 0).T
    names = features.label_names
    agreement = between(votes[row, first], votes[row, second], len(names))
    value = float(agreement.value) if len(row) else None
    labels = {
        name: {"share": float(share), "agreement": float(of_label)}
        for name, share, of_label in zip(names, agreement.share, agreement.by_label, strict=True)
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
            f"teacher is sure by {sure:.2f} only: its outputs are flat, as of a softmax taken "
            "twice, of logits that were scaled down, or of photos in another range than it was "
            "trained on; `chebsplat check-teacher` tries the usual ones"
        )
        log.warning("%s", job.facts["doubt"])
    elif value < settings.low:
        job.facts["doubt"] = (
            f"views agree by {value:.2f} on what points are (1: always, 0: by chance), below "
            f"{settings.low:g}: the 2D teacher does not know this scene, or its mean, std or order "
            "of colours is wrong (`chebsplat check-teacher` tries the usual ones); name another "
            "(docs/teachers.md), or teacher.kind=none for colour alone"
        )
        log.warning("%s", job.facts["doubt"])
    else:
        log.info("views agree by %.2f on what points are (1: always, 0: by chance)", value)
    ViewAgreement(value, len(row), len(views), labels).write(job.out)


def sure_of(features: Features, views: list[int]) -> float:
    """Sureness of a segmenter in its likeliest class; 1 of others, as cosines are no certainty."""
    if features.convention.get("output") != "logits" or features.confidence is None:
        return 1.0
    mean = np.mean([np.asarray(features.confidence[view], np.float32).mean() for view in views])
    return sureness(float(mean), len(features.label_names))


def training_views(
    capture: Capture, points: Points, features: Features
) -> list[tuple[int, int, int]]:
    """Indices (in capture, points, features) of each training view with a pose.

    Raises: InputError on artifacts of several scenes, DataFailure where there is no such view.
    """
    row, feature_row = (
        {name: k for k, name in enumerate(names)} for names in (capture.names, features.names)
    )
    if unknown := [name for name in points.names if name not in row or name not in feature_row]:
        raise InputError(
            f"the points have a view {unknown[0]} that capture or features lack; "
            "pass those of one scene"
        )
    views = [
        (row[name], k, feature_row[name])
        for k, name in enumerate(points.names)
        if not capture.is_test[row[name]]
    ]
    if not views:
        raise DataFailure(
            "no training view has a camera; lower ingest.test_every's share of test views"
        )
    return views


def labels_of(
    job: Job,
    capture: Capture,
    points: Points,
    features: Features,
    views: list[tuple[int, int, int]],
    sample: np.ndarray,
) -> np.ndarray:
    """Labels that the views [V] give the points `sample` [N], i64 [N, V]; -1 where not visible.

    Choices: visibility is by depth, where the capture has it in the frame of the points; by the
      tracks of structure from motion, where there are any; otherwise by nearer points.
    """
    means, size = points.means.astype(np.float64), capture.size
    depths = capture.depth if capture.cam_from_world is not None else None
    number_of = np.full(len(means), -1)
    number_of[sample] = np.arange(len(sample))
    # the last row: of points outside the sample
    tracked = np.zeros((len(sample) + 1, len(points.names)), bool)
    tracked[number_of[points.tracks[:, 0]], points.tracks[:, 1]] = True
    votes = np.full((len(sample), len(views)), UNSEEN, np.int64)
    for (number, (row, place, feature_row)), _ in job.progress.track(
        enumerate(views), len(views), "agree"
    ):
        image = project(means, points.Ks[place], points.cam_from_world[place], size)
        if depths is not None:
            visible = unhidden(image, size, depths[row])[sample]
        elif len(points.tracks):
            visible = np.isfinite(image[sample, 0]) & tracked[:-1, place]
        else:
            visible = unhidden(image, size)[sample]
        columns, rows = image[sample[visible], :2].astype(np.int64).T
        if features.pseudo_labels is None:
            labels = decode_labels(
                features.features[feature_row].astype(np.float32), features.label_embeddings
            )
        else:
            labels = features.pseudo_labels[feature_row]
        height, width = labels.shape
        of_points = labels[rows * height // size[1], columns * width // size[0]].astype(np.int64)
        if capture.loss_mask is not None:
            of_points[~capture.loss_mask[row][rows, columns]] = UNSEEN
        votes[visible, number] = of_points
    return votes
