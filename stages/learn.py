"""learn: a scene's lesson about shape for later scenes: sums over its points (Eqs 14-15)."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

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
from chebsplat.lifting.blend import familiar
from chebsplat.shape.lessons import LEAST_VIEWS, Sums, novelty, odds, scaled_novelty, summed
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.answers import (
    into_meanings,
    of_features,
    to_knowledge,
    units,
    unnamed,
    words_by_label,
    words_of,
)
from chebsplat.stages.shape_models.surfaces import in_scene, swept_Ks
from chebsplat.stages.teacher_models.text_encoder import match_names

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
    Choices: trust is measured against what ships, not against what earlier lessons have made of
      it: so it does not depend on the order in which scenes are learned.
    """
    settings, start = job.config.learn, read_knowledge(job.inputs["start"])
    capture = Capture.read(job.inputs["capture"])
    points, features = Points.read(job.inputs["points"]), Features.read(job.inputs["features"])
    descriptors = Descriptors.read(job.inputs["descriptors"])
    notes = {
        "scene": job.config.scene.name,
        "capture": read_manifest(job.inputs["capture"]).key,
        "teacher": features.convention.get("teacher", features.convention["kind"]),
        "given": features.convention["kind"] in VOUCHED,
        "unnamed": [],
    }
    encoding = Encoding.read(job.inputs["encoding"])
    z = encoding.features.astype(np.float32)
    try:
        if not len(z):
            raise DataFailure(encoding.notes["none"])
        if settings.points is not None:
            world = World.read(capture.source)
            meanings, n_views, embeddings = labelled(
                Path(settings.points), start, descriptors, world
            )
            notes |= {"given": True, "teacher": "labelled points"}
        else:
            meanings, n_views = average_views(job, start, capture, points, features, descriptors)
            embeddings = named_embeddings(job, start, features)
            notes["unnamed"] = unnamed(start, features)
        labels = decode_labels(meanings, embeddings)
        weights = odds(n_views, labels)
        in_channels = settings.points is None and of_features(features)
        words = words_by_label(start, features)[labels] if in_channels else meanings
    except DataFailure as error:
        job.left_out("a lesson", str(error))
        p, d = start.map.shape
        nothing = Sums(np.zeros((p, p)), np.zeros((p, d)), 0.0)
        write_lesson(job.out, Lesson(nothing, notes | {"none": str(error)}))
        return
    if notes["unnamed"]:
        job.left_out(
            "labels without a word",
            f"knowledge has no word for {', '.join(notes['unnamed'])}: no vote from shape",
        )
    sums = summed(z, np.concatenate([meanings, words], 1), weights)
    visible, half = n_views >= LEAST_VIEWS, meanings.shape[1]
    answers = z @ (start.map[:, :half] if in_channels else start.map[:, half:])
    missed = (
        weights
        @ np.square(answers - meanings).sum(1)
        / max(float(weights @ np.square(meanings).sum(1)), 1e-30)
    )
    rho, spread = novelty(sums, start.scale, start.basis), sums.spread()
    notes |= {
        "n_points": int(visible.sum()),
        "n_labels": len(embeddings),
        "rho": rho,
        "sigma": spread,
        "novelty": scaled_novelty(rho, spread),
        "known": KNOWN * start.card["novelty"][KIND[descriptors.notes["of"]]],
        "familiar": familiar(meanings[visible], answers[visible], embeddings),
        "alike": float((decode_labels(answers[visible], embeddings) == labels[visible]).mean()),
    }
    job.facts |= notes | {"unexplained": float(missed)}
    write_lesson(job.out, Lesson(sums, notes))


def average_views(
    job: Job,
    start: Knowledge,
    capture: Capture,
    points: Points,
    features: Features,
    descriptors: Descriptors,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean features of the described points over training views, f64 [N, d]; numbers of views [N].

    Raises: DataFailure where no training view has a camera and features.
    """
    row = {name: view for view, name in enumerate(capture.names)}
    place = {name: view for view, name in enumerate(features.names)}
    used = [
        k for k, name in enumerate(points.names) if not capture.is_test[row[name]] and name in place
    ]
    if not used:
        raise DataFailure("no training view has a camera and features")
    Ks, within = points.Ks[used], SEEN_WITHIN
    depth: Iterable[np.ndarray]
    if capture.depth is not None:
        depth = (capture.depth[row[points.names[k]]] for k in used)
    else:
        assert points.depths is not None
        depth, within = points.depths[used], SWEPT_WITHIN
        Ks = swept_Ks(points, capture.size[0])[used]
    meaning = into_meanings(job.inputs["start"], start, features)
    views = (meaning(place[points.names[k]]) for k in used)
    means, _ = in_scene(descriptors)
    return averaged(
        means,
        depth,
        views,
        start.matrix.shape[1],
        Ks,
        points.cam_from_world[used],
        within,
        descriptors.unit,
    )


def named_embeddings(job: Job, start: Knowledge, features: Features) -> np.ndarray:
    """Embeddings f32 [L, d] of the scene's labels in the channels of knowledge; where the scene has
    codes of classes, of those that knowledge has a word for.
    """
    if not of_features(features):
        return words_of(job.inputs["start"], start, features)[1]
    return np.asarray(features.label_embeddings @ to_knowledge(start, features))


def labelled(
    path: Path, start: Knowledge, descriptors: Descriptors, world: World
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A user's words for points: embeddings f32 [N, d] of the described points, zero without word;
    n_views [N], LEAST_VIEWS of those with one; and the unit embeddings f32 [L, d] of the words.

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
    meanings = np.zeros((len(means), start.matrix.shape[1]), np.float32)
    embeddings = units(start.embeddings[rows])
    np.add.at(meanings, nearest[beside], embeddings[beside])
    return units(meanings), np.where(meanings.any(1), LEAST_VIEWS, 0), np.unique(embeddings, axis=0)


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
