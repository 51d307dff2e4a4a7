"""learn: a scene's lesson about shape for later scenes: sums over its points (Eqs 14-15)."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.features import Features
from chebsplat.formats.knowledge import Knowledge, read_knowledge
from chebsplat.formats.lesson import Lesson, write_lesson
from chebsplat.formats.names import suggest
from chebsplat.formats.points import Points
from chebsplat.formats.world import World
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.averages import SEEN_WITHIN, SWEPT_WITHIN, averaged
from chebsplat.lifting.blend import (
    Shape,
    believed,
    blend,
    effective,
    errors_alike,
    familiar,
    lengths,
    strength_of,
    supported,
)
from chebsplat.lifting.observations import halves_of
from chebsplat.shape.lessons import (
    LEAST_VIEWS,
    Sums,
    novelty,
    odds,
    scaled_novelty,
    summed,
    unexplained,
)
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.answers import (
    answering,
    into_channels,
    units,
    unnamed,
    words_by_label,
)
from chebsplat.stages.shape_models.surfaces import in_scene, swept_Ks
from chebsplat.stages.teacher_models.text_encoder import match_names

SHAPE_WORTH = 16.0  # times what shape counts for in `refine`, where labels are decided
REACH = 0.3  # metres from a label to the described point that it is of
KIND = {"depth": "held_out", "swept depth": "held_out_swept"}  # of rooms, by kind of surface
# times the largest novelty of such rooms, held out: a scene above it is new in kind
KNOWN = 1.05
VOUCHED = ("labels", "given")  # kinds of teacher that the user answers for


def run(job: Job) -> None:
    """The lesson of a scene, and the evidence by which later scenes trust it.

    Reads `capture`, `points`, `descriptors`, `encoding`, `features`, and the `knowledge` that
    ships, against which it is judged. Writes `lesson`. It is empty where a scene shows too little
    of a surface.
    Choices: labels are decided, and trust is measured, with what ships, not with what earlier
      lessons have made of it: so neither depends on the order in which scenes are learned.
    """
    settings, start = job.config.learn, read_knowledge(job.inputs["start"])
    capture = Capture.read(job.inputs["capture"])
    features, encoding = (
        Features.read(job.inputs["features"]),
        Encoding.read(job.inputs["encoding"]),
    )
    descriptors = Descriptors.read(job.inputs["descriptors"])
    notes = {
        "scene": job.config.scene.name,
        "capture": read_manifest(job.inputs["capture"]).key,
        "teacher": features.convention.get("teacher", features.convention["kind"]),
        "given": features.convention["kind"] in VOUCHED,
        "unnamed": [],
    }
    z = encoding.features.astype(np.float32)
    try:
        if not len(z):
            raise DataFailure(encoding.notes["none"])
        if settings.points is not None:
            world = World.read(capture.source)
            teaching = by_points(Path(settings.points), start, descriptors, world, z)
            notes |= {"given": True, "teacher": "labelled points"}
        else:
            points = Points.read(job.inputs["points"])
            teaching = by_views(
                job.inputs["start"], start, capture, points, features, descriptors, z
            )
            notes["unnamed"] = unnamed(start, features)
        weights = odds(teaching.n_views, teaching.labels)
    except DataFailure as error:
        job.left_out("a lesson", str(error))
        p, d = start.map.shape
        nothing = Sums(np.zeros((p, p)), np.zeros((p, d)), 0.0)
        write_lesson(job.out, Lesson(nothing, notes | {"none": str(error)}))
        return
    if notes["unnamed"]:
        job.left_out(
            "labels without a word",
            f"knowledge has no word for {', '.join(notes['unnamed'])}: not learned, and no vote "
            "from shape",
        )
    sums = summed(z, teaching.words, weights)
    rho, spread = novelty(sums, start.scale, start.basis), sums.spread()
    notes |= {
        "n_points": int((teaching.n_views >= LEAST_VIEWS).sum()),
        "n_labels": len(np.unique(teaching.labels[weights > 0])),
        "rho": rho,
        "sigma": spread,
        "novelty": scaled_novelty(rho, spread),
        "known": KNOWN * start.card["novelty"][KIND[descriptors.notes["of"]]],
        "familiar": teaching.familiar,
        "alike": teaching.alike,
    }
    job.facts |= notes | {"unexplained": unexplained(sums, start.map.astype(np.float64))}
    write_lesson(job.out, Lesson(sums, notes))


class Taught(NamedTuple):
    """Labels of the N described points of a scene, as its lesson teaches them.

    labels:   int [N], index of a label; n_views: i64 [N], that a point is seen in, 0: not to learn.
    words:    f32 [N, d], unit embedding of each label's word, zero of labels without one.
    familiar: of `blend.familiar`; alike: share of labels that shape and teacher have alike.
    """

    labels: np.ndarray
    n_views: np.ndarray
    words: np.ndarray
    familiar: float
    alike: float


def by_views(
    path: Path,
    start: Knowledge,
    capture: Capture,
    points: Points,
    features: Features,
    descriptors: Descriptors,
    z: np.ndarray,
) -> Taught:
    """Labels that the training views' mean features and shape decide together.

    Args: path: of the knowledge start; z [N, p], features of shape of the described points.
    Raises: DataFailure where no training view has a camera and features, or knowledge has no word
      for any label.
    Choices: labels, not the teacher's mean features, which hold what it confuses.
    """
    answers = into_channels(path, start, features)(z @ start.map)
    shape = answering(path, start, features, answers)
    halves, half_views = average_halves(capture, points, features, descriptors)
    means, labels, worth = decide_labels(halves, half_views, shape)
    n_views, words = half_views.sum(0), words_by_label(path, start, features)
    named = np.asarray(words.any(1))
    by_teacher, by_shape = (decode_labels(of, shape.embeddings) for of in (means, answers))
    n_views = np.where(named[labels] & named[by_teacher], n_views, 0)
    judged = n_views >= LEAST_VIEWS
    return Taught(
        labels,
        n_views,
        words[labels],
        worth,
        float((by_teacher == by_shape)[judged].mean()) if judged.any() else 0.0,
    )


def decide_labels(
    halves: np.ndarray, half_views: np.ndarray, shape: Shape
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean features of N points over all views, f32 [N, C]; the label of each that these and shape
    decide, int [N]; and `familiar` of them.

    Args: halves [2, N, C], mean features over each half of the views; half_views [2, N] how many
      of them see each; shape: of the N points.
    Choices: errors that most views share would be taught to shape, which could then no longer
      correct them. Points are not smoothed, so that shape counts for SHAPE_WORTH times what it
      counts for in `refine`; where many views err independently, they outvote it all the same.
    """
    n_views = half_views.sum(0)
    total = (half_views[..., None] * halves).sum(0)
    means = (total / np.maximum(n_views, 1)[:, None]).astype(np.float32)
    worth = familiar(means, shape.answers, shape.embeddings)
    agreement = lengths(means)
    support = supported(means, n_views, agreement, shape)
    strength = SHAPE_WORTH * strength_of(support, worth, believed(means, n_views, shape, worth))
    evidence = effective(n_views, errors_alike(agreement, halves, half_views))
    decided = blend(means, evidence, shape.beside(means), strength)
    return means, decode_labels(decided, shape.embeddings), worth


def average_halves(
    capture: Capture, points: Points, features: Features, descriptors: Descriptors
) -> tuple[np.ndarray, np.ndarray]:
    """Mean unit features of the described points over each half of the training views, f32 [2, N,
    C], and how many of these see each, i64 [2, N].

    Raises: DataFailure where no training view has a camera and features.
    """
    row = {name: view for view, name in enumerate(capture.names)}
    place = {name: view for view, name in enumerate(features.names)}
    used = np.array(
        [
            k
            for k, name in enumerate(points.names)
            if not capture.is_test[row[name]] and name in place
        ],
        np.int64,
    )
    if not len(used):
        raise DataFailure("no training view has a camera and features")
    means, _ = in_scene(descriptors)
    depth, Ks, within = capture.depth, points.Ks, SEEN_WITHIN
    if depth is None:
        Ks, within = swept_Ks(points, capture.size[0]), SWEPT_WITHIN

    def depth_of(k: int) -> np.ndarray:
        """Depth of the view that is number k of the points' names."""
        of = points.depths[k] if depth is None else depth[row[points.names[k]]]  # type: ignore[index]
        return np.asarray(of)

    def average(views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean features over some of the views, and numbers of them."""
        return averaged(
            means,
            map(depth_of, views),
            (features.features[place[points.names[k]]] for k in views),
            features.features.shape[-1],
            Ks[views],
            points.cam_from_world[views],
            within,
            descriptors.unit,
        )

    half_of = halves_of(len(used))
    halves, half_views = zip(*(average(used[half_of == half]) for half in (0, 1)), strict=True)
    return np.stack(halves).astype(np.float32), np.stack(half_views)


def by_points(
    path: Path, start: Knowledge, descriptors: Descriptors, world: World, z: np.ndarray
) -> Taught:
    """A user's words for points, as LEAST_VIEWS views of the described points beside them.

    Args: z [N, p], features of shape of the described points.
    Raises: InputError naming the line that is no point, the word that knowledge lacks, or that
      nothing lies beside.
    Choices: a label is of the described point nearest to it, within REACH.
    """
    where, words = read_labels(path)
    rows = match_names(words, start.words)
    if -1 in rows:
        word = words[rows.index(-1)]
        near = ", ".join(suggest(word, start.words))
        raise InputError(
            f"{path}: knowledge has no word {word}" + (f"; near: {near}" if near else "")
        )
    means, _ = in_scene(descriptors)
    away, nearest = cKDTree(means).query(world.inward(where))
    beside = away <= REACH * descriptors.unit
    if not beside.any():
        raise InputError(
            f"{path}: no point lies within {REACH} m of the scene's surface; give x, "
            "y, z in its frame"
        )
    embeddings, label = np.unique(units(start.embeddings[rows]), axis=0, return_inverse=True)
    votes = np.zeros((len(means), len(embeddings)), np.int64)
    np.add.at(votes, (nearest[beside], label[beside]), 1)
    labels, visible = votes.argmax(1), votes.any(1)
    meanings, answers = embeddings[labels], z @ start.map
    return Taught(
        labels,
        np.where(visible, LEAST_VIEWS, 0),
        meanings,
        familiar(meanings[visible], answers[visible], embeddings),
        float((decode_labels(answers, embeddings) == labels)[visible].mean()),
    )


def read_labels(path: Path) -> tuple[np.ndarray, list[str]]:
    """Points f64 [M, 3] and their words, of a CSV with columns x, y, z, word. Raises InputError."""
    where, words = [], []
    with path.open(newline="", encoding="utf-8") as handle:
        for number, row in enumerate(csv.DictReader(handle), start=2):
            try:
                where.append([float(row[axis]) for axis in "xyz"])
                words.append(row["word"].strip())
            except (KeyError, TypeError, ValueError, AttributeError):
                raise InputError(
                    f"{path}, line {number}: x, y, z and a word are needed, under these names"
                ) from None
    if not where or not np.isfinite(where).all():
        raise InputError(
            f"{path} holds no points, or some that are not finite; give x, y, z and a word a line"
        )
    return np.array(where), words
