"""Accuracy against a source's labels on training views, of a teacher and of Gaussians."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.cameras import unproject
from chebsplat.evaluation.metrics import IGNORE
from chebsplat.evaluation.protocols.task import resized, translated
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.labels.decode import decode_labels

N_VIEWS, N_PIXELS = 16, 256  # training views, and pixels of each
SEED = 0  # of the choice of pixels


def labels_right(
    capture: Capture, parameters: dict[str, np.ndarray], features: np.ndarray, teacher: Features
) -> float | None:
    """Accuracy of Gaussians' labels at the surface in some pixels of training views, by the nearest
    Gaussian; None where the capture has no labels with depth and poses. Test views take no part.

    Args: parameters: raw, of N Gaussians; features [N, C]; teacher: with labels to decode to.
    Choices: Gaussians of opacity below one half are no surface. Pixels of classes that are none of
      the teacher's labels do not count.
    """
    if capture.labels is None or capture.depth is None or capture.cam_from_world is None:
        return None
    rng, training = np.random.default_rng(SEED), np.flatnonzero(~capture.is_test)
    points, truth = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for view in training[
        np.linspace(0, len(training) - 1, min(N_VIEWS, len(training))).astype(int)
    ]:
        depth, labels = capture.depth[view], true_labels(capture, view, teacher.label_names)
        usable = (depth > 0) & (labels >= 0)
        if capture.loss_mask is not None:
            usable &= capture.loss_mask[view]
        pixels = np.argwhere(usable)
        pixels = pixels[rng.choice(len(pixels), min(N_PIXELS, len(pixels)), replace=False)]
        points.append(unproject(depth, capture.Ks[view], capture.cam_from_world[view], pixels))
        truth.append(labels[tuple(pixels.T)])
    solid = np.flatnonzero(parameters["logit_opacities"] > 0)
    if not len(solid) or not sum(map(len, truth)):
        return None
    nearest = solid[cKDTree(parameters["means"][solid]).query(np.concatenate(points))[1]]
    predicted = decode_labels(features[nearest], teacher.label_embeddings)
    return float((predicted == np.concatenate(truth)).mean())


def pixels_right(capture: Capture, teacher: Features) -> float | None:
    """Pixel accuracy of a teacher's pseudo labels on training views, -1 counting as wrong; None
    where the capture has no labels.
    """
    if capture.labels is None or teacher.pseudo_labels is None:
        return None
    right = counted = 0
    for view in np.flatnonzero(~capture.is_test).tolist():
        labels = np.asarray(teacher.pseudo_labels[view])
        truth = resized(true_labels(capture, view, teacher.label_names), labels.shape, centred=True)
        right += int(((labels == truth) & (truth >= 0)).sum())
        counted += int((truth >= 0).sum())
    return right / counted if counted else None


def true_labels(capture: Capture, view: int, label_names: list[str]) -> np.ndarray:
    """A view's labels [H, W] among these, -1 where it has none, or a class that is none of them."""
    assert capture.labels is not None
    return translated(capture.labels[view], capture.class_names or [], label_names, IGNORE)
