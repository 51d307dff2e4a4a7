"""Lifting of a 2D teacher's features to Gaussians, by one pass over the training views."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import expit

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats import lifted as lifted_format
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.lifting.observations import estimate, gathered, to_cells
from chebsplat.rasterize.lift import Lifted, lift
from chebsplat.stages.runtime.progress import Progress

MEDIAN_STEPS = 5  # of Weiszfeld's, from the mean of the views towards their geometric median
LEAST_WEIGHT = 0.1  # pixels that a Gaussian makes up of a view that sees it


def lifted_from(
    capture: Capture,
    cameras: Cameras,
    parameters: dict[str, np.ndarray],
    features: Features,
    gate: float,
    progress: Progress,
    median_steps: int = MEDIAN_STEPS,
) -> lifted_format.Lifted:
    """Features of Gaussians with these raw parameters, by the training views among these cameras.

    Args: gate: `lift.gate`; median_steps: from the mean of the views on.
    Raises:  InputError if artifacts do not belong together, DataFailure if no view sees a Gaussian.
    """
    names = training_names(capture, cameras, features)
    views = lifted_views(capture, cameras, parameters, features, names, gate)
    rounds = progress.track(views, len(names), "lift")
    n, n_channels = len(parameters["means"]), features.features.shape[-1]
    observations = gathered(n, n_channels, (view for view, _ in rounds))
    if len(observations.views) == 0:
        raise DataFailure(
            "no training view sees a Gaussian that the teacher has features for; check that splat "
            "and cameras are in the same frame"
        )
    estimates = estimate(observations, median_steps, LEAST_WEIGHT)
    notes = {"views": names, "n_observations": len(observations.views)}
    return lifted_format.Lifted(
        **{name: np.ascontiguousarray(values) for name, values in vars(estimates).items()},
        notes=notes,
    )


def training_names(capture: Capture, cameras: Cameras, features: Features) -> list[str]:
    """Names of the training views with a camera, in its order. Raises InputError, DataFailure."""
    is_test = dict(zip(capture.names, capture.is_test.tolist(), strict=True))
    if unknown := [name for name in cameras.names if name not in is_test]:
        raise InputError(
            f"the cameras have a view {unknown[0]} that the capture has not; pass "
            "artifacts of one scene"
        )
    if capture.size != (cameras.width, cameras.height):
        raise InputError(
            "the cameras are of another size than the capture; pass artifacts of one scene"
        )
    names = [name for name in cameras.names if not is_test[name]]
    available = set(features.names)
    if absent := [name for name in names if name not in available]:
        raise InputError(
            f"the features have no view {absent[0]}; run the teacher stage on this capture"
        )
    if not names:
        raise DataFailure(
            "no training view has a camera; lower ingest.test_every's share of test views"
        )
    return names


def lifted_views(
    capture: Capture,
    cameras: Cameras,
    parameters: dict[str, np.ndarray],
    features: Features,
    names: list[str],
    gate: float,
) -> Iterator[Lifted]:
    """Weighted sums of each of these views' features by Gaussian."""
    p = parameters
    gaussians = p["means"], p["quats"], np.exp(p["log_scales"]), expit(p["logit_opacities"])
    place, feature_row = (
        {name: k for k, name in enumerate(of.names)} for of in (cameras, features)
    )
    row = {name: k for k, name in enumerate(capture.names)}
    for name in names:
        values = features.features[feature_row[name]]
        mask = None if capture.loss_mask is None else capture.loss_mask[row[name]]
        cells, share = to_cells(
            values, counts_of(features, feature_row[name], values), capture.size, mask
        )
        camera = cameras.cam_from_world[place[name]], cameras.Ks[place[name]]
        yield lift(gaussians, *camera, capture.size, cells, share, gate)


def counts_of(features: Features, view: int, values: np.ndarray) -> np.ndarray:
    """Weight of each entry of a view's features, f32 [h, w].

    Choices: 0 where the teacher has no label; the confidence of labels that the source brings, as
      in the loss of a training; 1 elsewhere.
    """
    if features.pseudo_labels is None:
        return np.ones(values.shape[:2], np.float32)
    labelled = (features.pseudo_labels[view] >= 0).astype(np.float32)
    if features.convention.get("kind") == "given" and features.confidence is not None:
        labelled *= features.confidence[view].astype(np.float32)
    return np.asarray(labelled)
