"""Training views of a scene, joined by name: photos, masks, features, labels and depth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from chebsplat.cameras import unproject
from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.points import Points
from chebsplat.views import TaughtLabels, Views, remembered, stacked

# of features that are cached in memory; others are read when their view is used
FEATURE_BYTES = 64 << 20
# of photos, masks and depth likewise
PHOTO_BYTES, MASK_BYTES, DEPTH_BYTES = 2 << 30, 512 << 20, 512 << 20
N_PAIRS, N_PIXELS = 100, 1000  # views whose depths are compared, and pixels of each
SAME = 0.1  # of its depth, beyond which one view's point is hidden from the other


def training_rows(capture: Capture, points: Points) -> list[int]:
    """Indices into the points' names of the training views with a pose.

    Raises: InputError if the artifacts do not belong together, DataFailure if there is none.
    """
    is_test = dict(zip(capture.names, capture.is_test.tolist(), strict=True))
    if unknown := [name for name in points.names if name not in is_test]:
        raise InputError(
            f"the points know a view {unknown[0]} that the capture does not; pass "
            "artifacts of one scene"
        )
    used = [k for k, name in enumerate(points.names) if not is_test[name]]
    if not used:
        raise DataFailure("no training view is registered")
    return used


def training_views(
    capture: Capture,
    points: Points,
    features: Features | None,
    with_depth: bool = False,
    exposures: np.ndarray | None = None,
) -> Views:
    """The registered training views, joined by name, T of them. exposures: of their photos [T, 3],
    stops.

    Raises: InputError if artifacts do not belong together, DataFailure without a training view.
    """
    row = {name: view for view, name in enumerate(capture.names)}
    used = training_rows(capture, points)
    names = [points.names[k] for k in used]
    images, masks = capture.images, capture.loss_mask
    rows = [row[name] for name in names]
    of = labels_of = None
    if features is not None:
        source = {name: view for view, name in enumerate(features.names)}
        absent = [name for name in names if name not in source]
        if absent:
            raise InputError(
                f"the features have no view {absent[0]}; run the teacher stage on this capture"
            )
        stored = features.features
        read = remembered(
            lambda index: torch.from_numpy(stored[source[names[index]]]), FEATURE_BYTES
        )

        def of(index: int) -> torch.Tensor:
            return read(index).float()

        if features.pseudo_labels is not None and features.confidence is not None:
            labels_of = taught_labels(features, [source[name] for name in names])

    depth_of = measured_depth(capture, points, used) if with_depth else None
    return Views(
        names,
        stacked(lambda k: torch.from_numpy(images[rows[k]]), len(rows), PHOTO_BYTES),
        torch.from_numpy(points.Ks[used]).float(),
        torch.from_numpy(points.cam_from_world[used]).float(),
        None
        if masks is None
        else stacked(lambda k: torch.from_numpy(masks[rows[k]]), len(rows), MASK_BYTES),
        of,
        labels_of,
        depth_of,
        None if exposures is None else torch.from_numpy(exposures).float(),
    )


def taught_labels(features: Features, rows: list[int]) -> Callable[[int], TaughtLabels]:
    """Labels by index of training view, of these rows of the features; cached."""
    labels, confidence, codes = (
        features.pseudo_labels,
        features.confidence,
        torch.from_numpy(features.label_embeddings),
    )
    assert labels is not None
    assert confidence is not None

    classes = remembered(lambda index: torch.from_numpy(labels[rows[index]]).long(), FEATURE_BYTES)
    certainty = remembered(
        lambda index: torch.from_numpy(confidence[rows[index]]).float(), FEATURE_BYTES
    )

    def of(index: int) -> TaughtLabels:
        of_view = classes(index)
        return TaughtLabels(of_view, certainty(index), codes, bool((of_view >= 0).all()))

    return of


def measured_depth(
    capture: Capture, points: Points, used: list[int]
) -> Callable[[int, int], Tensor]:
    """z-depth, by index into `used` and step of pixels, of these views of the points: the
    capture's, otherwise swept depth, 0 unknown.

    Raises: ConfigError where there is none in the scene's unit.
    """
    depth, swept, (width, height) = capture.depth, points.depths, capture.size
    if depth is not None and capture.cam_from_world is not None:
        row = {name: view for view, name in enumerate(capture.names)}
        read = remembered(
            lambda index: torch.from_numpy(depth[row[points.names[used[index]]]]), DEPTH_BYTES
        )
    elif swept is not None:
        factor = width // swept.shape[2]  # of the blocks of pixels that a swept one stands for

        def read(index: int) -> Tensor:
            blocks = (
                torch.from_numpy(swept[used[index]])
                .repeat_interleave(factor, 0)
                .repeat_interleave(factor, 1)
            )
            whole = torch.zeros(height, width)
            whole[: len(blocks), : blocks.shape[1]] = blocks
            return whole

    else:
        raise ConfigError(
            "train.weight_depth needs a capture with poses and depth, and this one has no depth; "
            "set it to 0, or sweep the photos for it (sfm.dense=on)"
        )

    def at(index: int, factor: int) -> Tensor:
        rows, columns = (side // factor * factor for side in (height, width))
        return read(index)[:rows:factor, :columns:factor]

    return at


def disagreement(capture: Capture, points: Points) -> float:
    """Median over points of |z' / z - 1|, of depths z' and z in two training views; 0 if no two
    views see a point in common.
    """
    assert capture.depth is not None
    row, rng = {name: view for view, name in enumerate(capture.names)}, np.random.default_rng(0)
    used = training_rows(capture, points)
    differences = [np.zeros(0)]
    for a, b in rng.choice(used, (N_PAIRS, 2)):
        one, other = (np.asarray(capture.depth[row[points.names[view]]]) for view in (a, b))
        pixels = np.stack([rng.integers(0, side, N_PIXELS) for side in one.shape], 1)
        pixels = pixels[one[pixels[:, 0], pixels[:, 1]] > 0]  # nan is none
        world = unproject(one, points.Ks[a], points.cam_from_world[a], pixels)
        projected = (
            world @ points.cam_from_world[b, :3, :3].T + points.cam_from_world[b, :3, 3]
        ) @ points.Ks[b].T
        projected = projected[projected[:, 2] > 0]
        column, line = (np.floor(projected[:, axis] / projected[:, 2]) for axis in (0, 1))
        inside = (column >= 0) & (column < other.shape[1]) & (line >= 0) & (line < other.shape[0])
        there = other[line[inside].astype(int), column[inside].astype(int)]
        measured = there > 0
        apart = np.abs(projected[inside, 2][measured] / there[measured] - 1)
        if a != b:
            differences.append(apart[apart < SAME])
    every = np.concatenate(differences)
    return float(np.median(every)) if len(every) else 0.0
