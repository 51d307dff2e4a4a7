"""query: the Gaussians of a finished scene that match some words, and their relevancy by label."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.calibration import calibration_of
from chebsplat.formats.features import Features
from chebsplat.formats.names import suggest
from chebsplat.formats.onnx_files import model_sha256
from chebsplat.formats.teacher_model import EMBEDDED, TeacherModel, read_label_table, read_teacher
from chebsplat.labels.calibration import CUT, Calibration, presence, probability, relevancy
from chebsplat.labels.names import folded
from chebsplat.stages.teacher_models.text_encoder import match_names, text_embeddings

log = logging.getLogger("chebsplat")

CANONICAL = ("object", "things", "stuff", "texture")  # LERF's: phrases that fit anything


@dataclass
class Query:
    """A query in a scene's channels: its embedding [C], and those that it is compared with [K, C].

    rivals, calibration: f32 [R, C] and coefficients of the teacher, where its relevancy is
      calibrated and the text is a word of it; None: scores are LERF's relevancy. closed: the scene
      knows its labels alone, and this is one of them.
    """

    text: str
    embedding: np.ndarray
    phrases: list[str]
    against: np.ndarray
    rivals: np.ndarray | None = None
    calibration: Calibration | None = None
    closed: bool = False

    def scores(self, features: np.ndarray) -> np.ndarray:
        """f32 [...] in [0, 1] of features [..., C]: probability, or LERF's relevancy."""
        if self.calibration is None or self.rivals is None:
            return relevancy(features, self.embedding, self.against)
        return probability(features, self.embedding, self.rivals, self.calibration)

    def answer(self, features: np.ndarray) -> Relevancy:
        """The answer of a whole scene by its features [N, C]."""
        scores = self.scores(features)
        if self.calibration is not None:
            return Relevancy(self.text, scores, True, presence(scores, self.calibration))
        return Relevancy(
            self.text, scores, False, float((scores > CUT).any()) if self.closed else None
        )


@dataclass(frozen=True, eq=False)
class Relevancy:
    """A scene's answer to a query.

    scores:     f32 [N] in [0, 1] of every Gaussian: the probability that it is what the words mean,
      where calibrated; otherwise LERF's relevancy, above 0.5 where the words fit better than all
      phrases that they are compared with.
    calibrated: true where scores are probabilities.
    presence:   the probability that the scene has it at all; None where uncalibrated.
    """

    text: str
    scores: np.ndarray
    calibrated: bool
    presence: float | None

    @property
    def cut(self) -> float:
        """The suggested threshold; scores above it are selected."""
        return CUT

    @property
    def selected(self) -> np.ndarray:
        """Mask [N] of the Gaussians above the cut."""
        mask: np.ndarray = self.scores > self.cut
        return mask

    @property
    def present(self) -> bool | None:
        """True where the scene likely has it; None where uncalibrated."""
        return None if self.presence is None else self.presence > 0.5

    def __str__(self) -> str:
        count = int(self.selected.sum())
        what = (
            f"are likelier than not {self.text!r}"
            if self.calibrated
            else (f"have a relevancy above {self.cut}")
        )
        text = f"{count} of {len(self.scores)} Gaussians {what}"
        if self.presence is None:
            return f"{text}; uncalibrated: there may be none in the scene"
        return (
            text
            if self.present
            else (f"{text}; {self.text!r} is probably not here ({self.presence:.0%})")
        )


def read_features(path: Path) -> tuple[Features, str | None]:
    """A scene's `features` artifact, and the model that made it; None: the embedded one."""
    return Features.read(path), read_manifest(path).config["teacher"]["model"]


def is_closed(features: Features) -> bool:
    """True where the teacher scores its own labels only."""
    return (
        features.convention["kind"] in ("labels", "given")
        or features.convention.get("output") == "logits"
    )


def understood(path: Path, text: str, phrases: list[str], calibrated: bool = True) -> Query:
    """A query by the text space of the teacher that the scene was trained from.

    Args: calibrated: use the teacher's calibration where there is one.
    Choices: with `phrases` the text is compared with these, by LERF's relevancy; a text that is not
      in the teacher's table, which the calibration does not cover, with LERF's own phrases.
    """
    features, model = read_features(path)
    if is_closed(features):
        return among_labels(features, text, phrases)
    teacher = teacher_of(features, model)
    calibration = (
        calibration_of(teacher.path)
        if calibrated and not phrases and all(are_words([text], teacher))
        else None
    )
    if calibration is not None:
        vectors = embed_words([text, *calibration.rivals], features, model)
        return Query(
            text,
            vectors[0],
            calibration.rivals,
            vectors[1:],
            vectors[1:],
            Calibration(**calibration.calibration),
        )
    try:
        vectors = embed_words([text, *(phrases or CANONICAL)], features, model)
    except InputError as error:
        if phrases or repr(CANONICAL[0]) not in str(error):
            raise
        raise InputError(
            f"{error}; or choose with --against what the query is weighed against"
        ) from None
    return Query(text, vectors[0], phrases or list(CANONICAL), vectors[1:])


def teacher_of(features: Features, model: str | None) -> TeacherModel:
    """The ONNX teacher of a scene's features. Raises InputError if it is no longer the same."""
    teacher = read_teacher(Path(model) if model else EMBEDDED)
    if model_sha256(teacher.path) != features.convention["sha256"]:
        raise InputError(
            f"{teacher.path} is not the model that this scene was trained from; run the scene again"
        )
    return teacher


def are_words(texts: list[str], teacher: TeacherModel) -> list[bool]:
    """True for each text that a calibration covers: words of the teacher's table, if any."""
    if teacher.labels is None:
        return [True] * len(texts)
    return [row >= 0 for row in match_names(texts, read_label_table(teacher.labels)[0], False)]


def embed_words(words: list[str], features: Features, model: str | None) -> np.ndarray:
    """Words [L] -> f32 [L, C] by the ONNX teacher. Raises InputError if that has changed."""
    vectors = text_embeddings(words, teacher_of(features, model))
    if features.channels is not None:
        vectors = features.channels.embed(vectors)
        share = float(np.linalg.norm(vectors[0]))
        log.debug("the scene's channels keep %.0f %% of the query's embedding", 100 * share)
    return vectors


def among_labels(features: Features, text: str, phrases: list[str]) -> Query:
    """A query of a scene whose teacher scores its own labels only."""
    names = features.label_names
    rows = match_names([text, *phrases], names, last_word=False)
    target, others = rows[0], rows[1:]
    for word, row in zip((text, *phrases), rows, strict=True):
        if row < 0:
            near = suggest(folded(word), map(folded, names))
            raise ConfigError(
                f"{word!r} is no label of this scene, and its teacher (kind "
                f"{features.convention['kind']}) knows no "
                f"other words{'; near: ' + ', '.join(near) if near else ''}. Labels: "
                f"{', '.join(names)}. For free text "
                "run the scene with teacher.kind=auto"
            )
    others = others or [k for k in range(len(names)) if k != target]
    if not others:
        raise ConfigError(
            f"{text!r} is the scene's only label: there is nothing to weigh it against"
        )
    return Query(
        text,
        features.label_embeddings[target],
        [names[k] for k in others],
        features.label_embeddings[others],
        closed=not phrases,
    )


def table(answer: Relevancy, labels: np.ndarray, names: list[str], n_rows: int) -> list[str]:
    """Lines of a table: the labels of the highest mean score."""
    rows = [(float(answer.scores[labels == k].mean()), k) for k in np.unique(labels) if k >= 0]
    width = max([len(name) for name in names] + [5])
    mean = "mean probability" if answer.calibrated else "mean relevancy"
    lines = [f"{'label':{width}s}  {mean}  Gaussians  above {answer.cut}"]
    for score, k in sorted(rows, reverse=True)[:n_rows]:
        mine = labels == k
        count = int(answer.selected[mine].sum())
        lines.append(f"{names[k]:{width}s}  {score:{len(mean)}.3f}  {mine.sum():9d}  {count:9d}")
    return lines
