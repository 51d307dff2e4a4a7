"""What knowledge of shape says of a scene's points, in the channels that the scene has."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from chebsplat.cameras import common_up, resized
from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.features import Features
from chebsplat.formats.knowledge import Knowledge, read_knowledge
from chebsplat.formats.points import Points
from chebsplat.labels.decode import shares
from chebsplat.lifting.surface import surface, swept_surface
from chebsplat.settings import DescribeSection
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import point_inputs
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.reconstruction.thinning import even
from chebsplat.stages.runtime.config import checked
from chebsplat.stages.teacher_models.text_encoder import found

log = logging.getLogger("chebsplat")
LEAST_SURE = 0.5  # of up, by the cameras
N_NEIGHBORS = 16  # that give a point its normal and covariance


class Cloud(NamedTuple):
    """Points of a surface: means [P, 3] scene units, normals [P, 3] unit, towards a camera, covariances [P, 3, 3]."""

    means: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray


def measured(points: Points) -> Cloud:
    """The surface that points of depth show, as evenly as knowledge was taught it."""
    kept = even(points)
    if len(kept) == len(points.means):
        return Cloud(points.means, points.normals, points.covariances)
    means = points.means[kept]
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, points.normals[kept]) < 0] *= -1
    return Cloud(means, normals, covariances)


def shown(
    parameters: dict[str, np.ndarray], poses: np.ndarray, Ks: np.ndarray, size: tuple[int, int], unit: float
) -> Cloud:
    """The surface that Gaussians show to views, for scenes whose points no depth has measured.

    Raises: DataFailure where they show too little of one.
    """
    means, eyes = surface(parameters, poses, Ks, size, unit)
    if len(means) <= N_NEIGHBORS:
        raise DataFailure(f"the Gaussians show {len(means)} points of a surface; shape cannot be told")
    return facing(means, eyes)


def swept(points: Points, width: int, unit: float) -> Cloud:
    """The surface that swept depth of photos of this width shows.

    Raises: DataFailure where that is too little of one.
    """
    assert points.depths is not None
    factor = width // points.depths.shape[2]  # of the blocks of pixels that a swept one stands for
    means, eyes = swept_surface(points.depths, resized(points.Ks, 1 / factor, 1 / factor), points.cam_from_world, unit)
    if len(means) <= N_NEIGHBORS:
        raise DataFailure(f"the photos' depth shows {len(means)} points of a surface; shape cannot be told")
    return facing(means, eyes)


def facing(means: np.ndarray, eyes: np.ndarray) -> Cloud:
    """Points [P, 3] with the shape of their neighbours, and normals towards the cameras [P, 3] that saw them."""
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, eyes - means) < 0] *= -1
    return Cloud(means, normals, covariances)


def known_shapes(
    path: Path, features: Features, cloud: Cloud, poses: np.ndarray, unit: float
) -> tuple[np.ndarray, dict[str, Any]]:
    """What the point encoder answers for each point, f32 [P, C], and facts for the manifest.

    Args: path: of the knowledge; features: of the scene's teacher, for their channels; poses [V, 4, 4] of its cameras;
          unit: scene units of a metre.
    Raises: InputError where the knowledge is damaged or of another teacher; DataFailure where it lacks a label's word.
    """
    knowledge = read_knowledge(path)
    translated = into_channels(path, knowledge, features)
    up, sure = up_of(poses)
    answers = answered(path, knowledge, cloud, up, unit)
    return translated(answers), {"up": [round(float(v), 4) for v in up], "up_confidence": round(sure, 3)}


def up_of(poses: np.ndarray) -> tuple[np.ndarray, float]:
    """Against gravity [3], and how sure that is. Choices: z, with a warning, where the cameras cannot tell."""
    up, sure = common_up(poses)
    if sure >= LEAST_SURE:
        return up, sure
    log.warning("the cameras do not tell which way is up (%.2f); z is taken", sure)
    return np.array([0.0, 0.0, 1.0]), sure


def answered(path: Path, knowledge: Knowledge, cloud: Cloud, up: np.ndarray, unit: float) -> np.ndarray:
    """What the encoder of the knowledge at `path` says of each point, in its own channels: f32 [P, d]."""
    describe = checked(DescribeSection, knowledge.describe, f"{path / 'knowledge.json'}: describe", InputError)
    inputs = point_inputs(*cloud, up=up, unit=unit, describe=describe)
    return PointEncoder.restored(knowledge.encoder, knowledge.weights).predict(inputs)


def into_channels(path: Path, knowledge: Knowledge, features: Features) -> Callable[[np.ndarray], np.ndarray]:
    """From answers [P, d] to the scene's channels [P, C]: through the channels of the teacher, or through words.

    Raises: InputError where the knowledge is of another teacher than the scene's; DataFailure where it lacks a word.
    Choices: through the teacher's channels nothing is lost but what the scene leaves out. Where a scene's features are
      codes of classes (noisy labels, labels of a source, segmenters), an answer becomes the mean of the codes, weighted
      by how near it is to the embeddings of their names.
    """
    if features.convention["kind"] == "onnx" and features.convention["output"] == "features":
        if features.convention["teacher"] != knowledge.teacher:
            raise InputError(
                f"{path} was taught for the teacher {knowledge.teacher}, the scene has "
                f"{features.convention['teacher']}; teach knowledge for it (`chebsplat knowledge`)"
            )
        channels = features.channels
        if channels is not None and channels.notes.get("digest") != knowledge.digest:
            raise InputError(f"{path} was taught for another version of {knowledge.teacher}; teach it again")
        matrix = knowledge.matrix.T if channels is None else knowledge.matrix.T @ channels.matrix
        return lambda answers: answers @ matrix
    rows = found(features.label_names, knowledge.words)
    if -1 in rows:
        raise DataFailure(f"{path} has no word for the label {features.label_names[rows.index(-1)]}")
    words = knowledge.embeddings[rows].astype(np.float32)
    return lambda answers: shares(answers, words) @ features.label_embeddings
