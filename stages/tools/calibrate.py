"""calibrate: what a teacher's relevancy means, by generated rooms whose points have names.

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

# no other rooms' (synthetic/layout.py); named here, where no scene depends on it
SEEDS = range(21_000, 21_100)
N_VIEWS, N_POINTS = 16, 20_000  # of a room
FITTED = 2000  # points of a room that the probability is fitted to
LEAST = 20  # points of a class, of which a room has it; fewer, and nobody can tell
FREQUENT = 1e-4  # share of points that a rival is the nearest word of
FOLDS = 3  # parts of the rooms, of which each is measured by a fit to the others


class Asked(NamedTuple):
    """Words, their embeddings [W, C], and the row of the class that each names, -1: none that rooms
    have.
    """

    words: list[str]
    embeddings: np.ndarray
    classes: np.ndarray


class Points(NamedTuple):
    """A room: unit features [N, C] of points that a view sees, and their classes [N], -1: none."""

    features: np.ndarray
    labels: np.ndarray


class Heard(NamedTuple):
    """A room: f32 [N, W, 2], the evidence of each point for each word, and the classes of points
    [N].
    """

    evidence: np.ndarray
    labels: np.ndarray


def calibrate(model: Path, n_rooms: int, progress: Progress) -> TeacherCalibration:
    """Calibrate the relevancy of an ONNX teacher of features on generated rooms.

    Args: n_rooms: FOLDS at least, of SEEDS.
    Raises: ConfigError on a closed-set teacher or a number of rooms that cannot be; InputError
      where the teacher cannot be read or knows no class; DataFailure where rooms do not tell words
      apart.
    """
    from chebsplat.stages.teacher_models.image_encoder import TeacherInference

    teacher = read_teacher(model)
    if teacher.output != "features":
        raise ConfigError(
            f"{teacher.settings}: output is {teacher.output}; a query is weighed in features"
        )
    if not FOLDS <= n_rooms <= len(SEEDS):
        raise ConfigError(f"{FOLDS} to {len(SEEDS)} rooms are needed, not {n_rooms}")
    asked, network = asked_words(teacher), TeacherInference(teacher, 1)
    rooms = [points(seed, network) for seed, _ in progress.track(SEEDS[:n_rooms], n_rooms, "rooms")]
    vocabulary = table_words(str(model))
    embedded = text_embeddings(vocabulary, teacher)
    rows = frequent([room.features for room in rooms], embedded, FREQUENT)
    heard = [
        Heard(evidence(room.features, asked.embeddings, embedded[rows]), room.labels)
        for room in rooms
    ]
    try:
        apart = [
            fit([room for k, room in enumerate(heard) if k % FOLDS != fold], asked)
            for fold in range(FOLDS)
        ]
        whole = fit(heard, asked)
    except ValueError as error:
        raise DataFailure(f"{model}: generated rooms do not calibrate it: {error}") from None
    made: dict[str, Any] = {
        "chebsplat": chebsplat.__version__, "rooms": n_rooms, "first_seed": SEEDS[0], "views": N_VIEWS,
        "points": sum(len(room.labels) for room in rooms), "words": len(asked.words), "vocabulary": len(vocabulary),
        "on_rooms_left_out": figures(heard, apart, asked),
    }  # fmt: skip
    names = [vocabulary[row] for row in rows]
    return TeacherCalibration(teacher.name, model_sha256(model), names, rounded(whole), made)


def rounded(of: Calibration) -> dict[str, float]:
    """Its coefficients by name, as they are kept."""
    return {name: round(value, 4) for name, value in of._asdict().items()}


def asked_words(teacher: TeacherModel) -> Asked:
    """What classes are called, and words of things that no generated room has; those that the
    teacher knows.
    """
    listed = tomllib.loads(EMBEDDED.with_name("words.toml").read_text())
    pairs = [(word, k) for k, name in enumerate(CLASS_NAMES) for word in listed["training"][name]]
    pairs += [(word, -1) for word in listed["absent"]["calibration"]]
    known, rows, unknown = [], [], []
    for word, k in pairs:
        try:
            rows.append(text_embeddings([word], teacher)[0])
            known.append((word, k))
        except InputError:
            unknown.append(word)
    if not {k for _, k in known} - {-1}:
        raise InputError(
            f"{teacher.path} knows no word for what generated rooms have; it cannot be calibrated"
        )
    if unknown:
        log.info("left out, as %s does not know them: %s", teacher.name, ", ".join(unknown))
    return Asked([word for word, _ in known], np.stack(rows), np.array([k for _, k in known]))


def points(seed: int, network: Any) -> Points:
    """A room's points with what the teacher says of them, averaged over its views."""
    from chebsplat.lifting.averages import averaged
    from chebsplat.stages.shape_models.teaching_rooms import photographed, surface

    images, depth, labels, K, poses = photographed(seed, N_VIEWS)
    grid, _ = network.grid(images[0], 4)
    seen = np.stack(
        [network.features(image, grid, (1.0,), False, f"room {seed}") for image in images]
    )
    means, _, named = surface(depth, labels, K, poses, N_POINTS, np.random.default_rng([seed, 5]))
    features, n_views = averaged(
        means, depth, seen, seen.shape[-1], np.tile(K, (len(poses), 1, 1)), poses
    )
    features, named = features[n_views > 0], named[n_views > 0]
    return Points(features / np.linalg.norm(features, axis=1, keepdims=True).clip(1e-6), named)


def fit(rooms: list[Heard], asked: Asked) -> Calibration:
    """Coefficients of the greatest likelihood: of points first, then of rooms. Raises ValueError
    where there are none.

    Choices: points are asked only for words of classes, all pairs alike, so that a probability is
      that of one of 22 classes; rooms are asked for all words, what they have and what they lack
      weighing alike.
    """
    of_class = asked.classes >= 0
    inputs, truth = [], []
    for number, room in enumerate(rooms):
        rng = np.random.default_rng(number)
        rows = rng.choice(len(room.labels), min(FITTED, len(room.labels)), replace=False)
        rows = rows[room.labels[rows] >= 0]
        inputs.append(room.evidence[rows][:, of_class].reshape(-1, 2))
        truth.append((room.labels[rows][:, None] == asked.classes[of_class]).ravel())
    margin, cosine, bias = fitted(np.concatenate(inputs), np.concatenate(truth))
    first = Calibration(float(margin), float(cosine), float(bias), 1.0, 0.0)
    strengths, there = [], []
    for room in rooms:
        for word, k in enumerate(asked.classes):
            count = int((room.labels == k).sum()) if k >= 0 else 0
            if not 0 < count < LEAST:
                strengths.append(strongest(probable(room.evidence[:, word], first)))
                there.append(count > 0)
    held = np.array(there)
    weights = np.where(held, 0.5 / max(held.sum(), 1), 0.5 / max((~held).sum(), 1))
    strength, offset = fitted(np.array(strengths)[:, None], held, weights)
    return first._replace(strength=float(strength), offset=float(offset))


def figures(rooms: list[Heard], apart: list[Calibration], asked: Asked) -> dict[str, float]:
    """Of points by class words, at the cut, pooled; and of rooms: what they have found, what no
    room has refused.
    """
    right = chosen = wanted = 0
    found: list[bool] = []
    refused: list[bool] = []
    for number, room in enumerate(rooms):
        of = apart[number % FOLDS]
        for word, k in enumerate(asked.classes):
            scores = probable(room.evidence[:, word], of)
            here = presence(scores, of) > CUT
            truth, known = room.labels == k, room.labels >= 0
            if k < 0:
                refused.append(not here)
            elif truth.sum() >= LEAST:
                found.append(here)
                selected = (scores > CUT) & known
                right += int((selected & truth).sum())
                chosen += int(selected.sum())
                wanted += int(truth.sum())
    shares = {"precision": right / max(chosen, 1), "recall": right / max(wanted, 1)}
    shares |= {"present_found": float(np.mean(found))} if found else {}
    shares |= {"absent_refused": float(np.mean(refused))} if refused else {}
    return {name: round(value, 4) for name, value in shares.items()}
