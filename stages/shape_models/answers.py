"""Translation between the channels of knowledge, of a scene, and of its teacher."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.features import Features
from chebsplat.formats.knowledge import Knowledge
from chebsplat.labels.decode import decode_labels, shares
from chebsplat.lifting.blend import Shape
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.teacher_models.text_encoder import match_names

TEMPERATURE = 0.05  # of cosines of answers with words, tuned on office0, shuffled0 and room0
# settings of descriptors that an encoder depends on
SEEN = ("n_angles", "max_degree", "anisotropy", "bandwidth")


def inputs_of(path: Path, descriptors: Descriptors, knowledge: Knowledge) -> PointInputs:
    """A scene's inputs of the encoder of `knowledge`, which was read from `path`.

    Raises: DataFailure where the scene shows no surface, or was described with other settings than
      the encoder was trained with.
    """
    if not len(descriptors.means):
        raise DataFailure(descriptors.notes["none"])
    if other := [
        name for name in SEEN if descriptors.notes["settings"][name] != knowledge.describe[name]
    ]:
        raise DataFailure(
            f"{path} was taught on descriptors with "
            f"describe.{other[0]}={knowledge.describe[other[0]]}"
        )
    of = descriptors
    return PointInputs(of.own, of.means, of.normals, of.descriptors, of.neighbors)


def answered(knowledge: Knowledge, inputs: PointInputs) -> np.ndarray:
    """Answers of knowledge at points, f32 [N, d], among the embeddings of its words."""
    return encoded(knowledge, inputs) @ knowledge.map


def encoded(knowledge: Knowledge, inputs: PointInputs) -> np.ndarray:
    """Features of shape of points, f32 [N, p]."""
    return PointEncoder.restored(knowledge.encoder, knowledge.weights).encode(inputs)


def into_channels(
    path: Path, knowledge: Knowledge, features: Features
) -> Callable[[np.ndarray], np.ndarray]:
    """From answers [N, d] to the scene's channels [N, C]: by the teacher's channels, or by words.

    Raises: InputError where the knowledge is of another teacher than the scene's; DataFailure where
      it has no word for any of its labels.
    Choices: through the teacher's channels nothing is lost but channels that the scene leaves out.
      Where a scene's features are codes of classes (noisy labels, labels of a source, segmenters),
      an answer becomes the mean of the codes, weighted by its similarity to the embeddings of their
      names; a label without a word gets no vote.
    """
    if of_features(features):
        check_teacher(path, knowledge, features)
        channels = features.channels
        matrix = knowledge.matrix.T if channels is None else knowledge.matrix.T @ channels.matrix
        return lambda answers: answers @ matrix
    named, embeddings = words_of(path, knowledge, features)
    codes = features.label_embeddings[named]
    return lambda answers: shares(answers, embeddings, TEMPERATURE) @ codes


def confused_with(path: Path, knowledge: Knowledge, features: Features) -> np.ndarray:
    """For each of a scene's labels the label that shape mostly gives to things of it, i64 [L]: its
    own, where shape tells it or was taught no class of that name.

    Args: knowledge: read from `path`.
    Raises: as `into_channels`.
    Choices: what shape mostly gives is the answer at the class's mean: a keyboard's is a desk. Of
      two labels of one class (table and dining table) it gives one to both.
    """
    rows = np.array(match_names(features.label_names, knowledge.classes), np.int64)
    own = np.arange(len(rows))
    if (rows < 0).all():
        return own
    answers = into_channels(path, knowledge, features)(knowledge.class_means @ knowledge.map)
    labels = decode_labels(answers, features.label_embeddings)
    return np.where(rows >= 0, labels[rows], own)


def answering(path: Path, knowledge: Knowledge, features: Features, answers: np.ndarray) -> Shape:
    """Shape that gives these answers [N, C], in the scene's channels.

    Args: knowledge: read from `path`.
    Raises: as `into_channels`.
    """
    missing = unnamed(knowledge, features)
    has_word = np.array([name not in missing for name in features.label_names])
    confused = confused_with(path, knowledge, features)
    return Shape(answers, features.label_embeddings, confused, has_word)


def words_by_label(path: Path, knowledge: Knowledge, features: Features) -> np.ndarray:
    """Unit embedding of each label in knowledge's channels, f32 [L, d]; zero without a word, and
    where the scene's channels hold so little of it that it would be read as another label.

    Args: knowledge: read from `path`.
    Raises: as `into_channels`.
    """
    if of_features(features):
        of, channels = features.label_embeddings, features.channels
        words = units((of if channels is None else of @ channels.inverse) @ knowledge.matrix)
        read = decode_labels(into_channels(path, knowledge, features)(words), of)
        known = read == np.arange(len(words))
    else:
        rows = np.array(match_names(features.label_names, knowledge.words))
        words, known = units(knowledge.embeddings[rows]), rows >= 0
    return np.where(known[:, None], words, 0).astype(np.float32)


def of_features(features: Features) -> bool:
    """True where a scene's channels are those of its teacher, and not codes of classes."""
    return bool(
        features.convention["kind"] == "onnx" and features.convention["output"] == "features"
    )


def check_teacher(path: Path, knowledge: Knowledge, features: Features) -> None:
    """Raise InputError where knowledge is of another teacher or version than the features."""
    teacher, channels = features.convention["teacher"], features.channels
    if teacher != knowledge.teacher:
        raise InputError(
            f"{path} was taught for the teacher {knowledge.teacher}, the scene has {teacher}; "
            "teach knowledge for it (`chebsplat knowledge teach`)"
        )
    if channels is not None and channels.notes.get("digest") != knowledge.digest:
        raise InputError(
            f"{path} was taught for another version of {knowledge.teacher}; teach it again"
        )


def words_of(path: Path, knowledge: Knowledge, features: Features) -> tuple[list[int], np.ndarray]:
    """Labels of the scene that knowledge has a word for, and these words' unit embeddings [L', d].

    Raises: DataFailure where there is none.
    """
    rows = match_names(features.label_names, knowledge.words)
    named = [label for label, row in enumerate(rows) if row >= 0]
    if not named:
        raise DataFailure(
            f"{path} has no word for any of the labels, {features.label_names[0]} among them"
        )
    return named, units(knowledge.embeddings[[rows[label] for label in named]])


def unnamed(knowledge: Knowledge, features: Features) -> list[str]:
    """Labels of the scene that knowledge has no word for: shape has no vote on them."""
    if of_features(features):
        return []
    rows = match_names(features.label_names, knowledge.words)
    return [name for name, row in zip(features.label_names, rows, strict=True) if row < 0]


def units(rows: np.ndarray) -> np.ndarray:
    """Rows of length 1, f32."""
    values = rows.astype(np.float32)
    return np.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True).clip(1e-6))
