"""calibrate: the relevancy of a teacher as a probability, fitted to generated rooms with labels.

See docs/method.md, section 16.
"""

from __future__ import annotations

import logging
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import chebsplat
from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.calibration import TeacherCalibration
from chebsplat.formats.onnx_files import model_sha256
from chebsplat.formats.teacher_model import EMBEDDED, TeacherModel, read_teacher
from chebsplat.labels.calibration import (
    CUT,
    Calibration,
    evidence,
    fitted,
    frequent,
    presence,
    probable,
    strongest,
)
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.teacher_models.text_encoder import text_embeddings
from chebsplat.stages.tools.page import table_words
from chebsplat.synthetic import CLASS_NAMES

log = logging.getLogger("chebsplat")

# not used in synthetic/layout.py; defined here, so that no scene's key depends on them
SEEDS = range(21_000, 21_100)
N_VIEWS, N_POINTS = 16, 20_000  # of a room
FITTED = 2000  # points of a room for the fit of the probability
LEAST = 20  # points of a class in a room; with fewer, but some, the room is not counted
FREQUENT = 1e-4  # share of points whose nearest word is a rival
FOLDS = 3  # of cross-validation over rooms


class Queries(NamedTuple):
    """Words, their embeddings [W, C], and the class that each names, -1: none of the rooms'."""

    words: list[str]
    embeddings: np.ndarray
    classes: np.ndarray


class Points(NamedTuple):
    """A room: unit features [N, C] of points in some view, and their classes [N], -1: none."""

    features: np.ndarray
    labels: np.ndarray


class RoomEvidence(NamedTuple):
    """A room: f32 [N, W, 2], evidence of each point for each word, and the points' classes [N]."""

    evidence: np.ndarray
    labels: np.ndarray


def calibrate(model: Path, n_rooms: int, progress: Progress) -> TeacherCalibration:
    """Calibrate the relevancy of an ONNX teacher of features on generated rooms.

    Args: n_rooms: FOLDS at least, of SEEDS.
    Raises: ConfigError on a closed-set teacher or a number of rooms that cannot be; InputError
      where the teacher cannot be read or knows no class; DataFailure where rooms do not separate
      words.
    """
    from chebsplat.stages.teacher_models.image_encoder import TeacherInference

    teacher = read_teacher(model)
    if teacher.output != "features":
        raise ConfigError(
            f"{teacher.settings}: output is {teacher.output}; a query is weighed in features"
        )
    if not FOLDS <= n_rooms <= len(SEEDS):
        raise ConfigError(f"{FOLDS} to {len(SEEDS)} rooms are needed, not {n_rooms}")
    queries, network = query_words(teacher), TeacherInference(teacher, 1)
    rooms = [points(seed, network) for seed, _ in progress.track(SEEDS[:n_rooms], n_rooms, "rooms")]
    vocabulary = table_words(str(model))
    vocabulary_embeddings = text_embeddings(vocabulary, teacher)
    rivals = frequent([room.features for room in rooms], vocabulary_embeddings, FREQUENT)
    room_evidence = [
        RoomEvidence(
            evidence(room.features, queries.embeddings, vocabulary_embeddings[rivals]), room.labels
        )
        for room in rooms
    ]
    try:
        fold_fits = [
            fit([room for k, room in enumerate(room_evidence) if k % FOLDS != fold], queries)
            for fold in range(FOLDS)
        ]
        whole = fit(room_evidence, queries)
    except ValueError as error:
        raise DataFailure(f"{model}: generated rooms do not calibrate it: {error}") from None
    facts: dict[str, Any] = {
        "chebsplat": chebsplat.__version__,
        "rooms": n_rooms,
        "first_seed": SEEDS[0],
        "views": N_VIEWS,
        "points": sum(len(room.labels) for room in rooms),
        "words": len(queries.words),
        "vocabulary": len(vocabulary),
        "on_rooms_left_out": figures(room_evidence, fold_fits, queries),
    }
    names = [vocabulary[row] for row in rivals]
    coefficients = {name: round(value, 4) for name, value in whole._asdict().items()}
    return TeacherCalibration(teacher.name, model_sha256(model), names, coefficients, facts)


def query_words(teacher: TeacherModel) -> Queries:
    """Synonyms of classes, and words of absent things, as far as the teacher has them."""
    words_of = tomllib.loads(EMBEDDED.with_name("words.toml").read_text())
    pairs = [(word, k) for k, name in enumerate(CLASS_NAMES) for word in words_of["training"][name]]
    pairs += [(word, -1) for word in words_of["absent"]["calibration"]]
    entries, rows, unknown = [], [], []
    for word, k in pairs:
        try:
            rows.append(text_embeddings([word], teacher)[0])
            entries.append((word, k))
        except InputError:
            unknown.append(word)
    if not {k for _, k in entries} - {-1}:
        raise InputError(
            f"{teacher.path} knows no word for what generated rooms have; it cannot be calibrated"
        )
    if unknown:
        log.info("left out, as %s does not know them: %s", teacher.name, ", ".join(unknown))
    return Queries([word for word, _ in entries], np.stack(rows), np.array([k for _, k in entries]))


def points(seed: int, network: Any) -> Points:
    """A room's points with the teacher's features, averaged over the views."""
    from chebsplat.lifting.averages import averaged
    from chebsplat.stages.shape_models.teaching_rooms import photographed, surface

    images, depth, labels, K, poses = photographed(seed, N_VIEWS)
    grid, _ = network.grid(images[0], 4)
    feature_maps = np.stack(
        [network.features(image, grid, (1.0,), False, f"room {seed}") for image in images]
    )
    means, _, classes = surface(depth, labels, K, poses, N_POINTS, np.random.default_rng([seed, 5]))
    features, n_views = averaged(
        means, depth, feature_maps, feature_maps.shape[-1], np.tile(K, (len(poses), 1, 1)), poses
    )
    features, classes = features[n_views > 0], classes[n_views > 0]
    return Points(features / np.linalg.norm(features, axis=1, keepdims=True).clip(1e-6), classes)


def fit(rooms: list[RoomEvidence], queries: Queries) -> Calibration:
    """Coefficients of maximum likelihood: first of points, then of rooms. Raises ValueError.

    Choices: points are scored by words of classes only, all pairs weighted equally, so that a
      probability is that of one of 22 classes; rooms are scored by all words, present and absent
      ones with equal total weight.
    """
    of_class = queries.classes >= 0
    inputs, truth = [], []
    for number, room in enumerate(rooms):
        rng = np.random.default_rng(number)
        rows = rng.choice(len(room.labels), min(FITTED, len(room.labels)), replace=False)
        rows = rows[room.labels[rows] >= 0]
        inputs.append(room.evidence[rows][:, of_class].reshape(-1, 2))
        truth.append((room.labels[rows][:, None] == queries.classes[of_class]).ravel())
    margin, cosine, bias = fitted(np.concatenate(inputs), np.concatenate(truth))
    first = Calibration(float(margin), float(cosine), float(bias), 1.0, 0.0)
    strengths, presences = [], []
    for room in rooms:
        for word, k in enumerate(queries.classes):
            count = int((room.labels == k).sum()) if k >= 0 else 0
            if not 0 < count < LEAST:
                strengths.append(strongest(probable(room.evidence[:, word], first)))
                presences.append(count > 0)
    has_class = np.array(presences)
    weights = np.where(has_class, 0.5 / max(has_class.sum(), 1), 0.5 / max((~has_class).sum(), 1))
    strength, offset = fitted(np.array(strengths)[:, None], has_class, weights)
    return first._replace(strength=float(strength), offset=float(offset))


def figures(
    rooms: list[RoomEvidence], fold_fits: list[Calibration], queries: Queries
) -> dict[str, float]:
    """Precision and recall of points by class words at the cut, pooled over held-out rooms; and the
    shares of rooms where present words are found and absent words refused.
    """
    n_right = n_selected = n_true = 0
    detected: list[bool] = []
    refused: list[bool] = []
    for number, room in enumerate(rooms):
        calibration = fold_fits[number % FOLDS]
        for word, k in enumerate(queries.classes):
            scores = probable(room.evidence[:, word], calibration)
            present = presence(scores, calibration) > CUT
            truth, labelled = room.labels == k, room.labels >= 0
            if k < 0:
                refused.append(not present)
            elif truth.sum() >= LEAST:
                detected.append(present)
                selected = (scores > CUT) & labelled
                n_right += int((selected & truth).sum())
                n_selected += int(selected.sum())
                n_true += int(truth.sum())
    shares = {"precision": n_right / max(n_selected, 1), "recall": n_right / max(n_true, 1)}
    shares |= {"present_found": float(np.mean(detected))} if detected else {}
    shares |= {"absent_refused": float(np.mean(refused))} if refused else {}
    return {name: round(value, 4) for name, value in shares.items()}
