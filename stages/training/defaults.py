"""Defaults of training settings that the config leaves open, decided by evidence of the scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from chebsplat.errors import ConfigError
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.points import Points
from chebsplat.settings import FEWEST_STEPS, PRINTED, TrainSection, default_gaussians, default_steps
from chebsplat.stages.training.views import disagreement, training_rows

OPEN = (None, "auto")  # values of a setting that leave it open
PUBLISHED = 30_000  # steps that 3DGS's rates are for
TRAVEL, FASTEST = 10.0, 5e-2  # a features' rate: less than TRAVEL over all steps does not arrive
DEPTH_WEIGHT = 0.8
MOST_APART = 0.003  # of a point's depth, within which views agree on it
LIFTED_FROM = 40  # views
LEAST_SPREAD = 0.05  # stops between the photos' exposures, from which on renders take them


@dataclass(frozen=True)
class Evidence:
    """Facts of a scene before its training, by which open settings are decided.

    n_views, n_pixels: of the training photos, in all.
    points_measured: initial points lie on measured surfaces.
    no_depth: reason for not using measured depth ("": it is used).
    labels: origin of labels with a confidence: `none`, `taught` (by the teacher), `given` (by the
      source); None: no teacher.
    exposure_spread: of the photos' exposures, stops; None: not measured.
    """

    n_views: int
    n_pixels: int
    points_measured: bool = False
    no_depth: str = "there is no depth"
    labels: str | None = None
    exposure_spread: float | None = None


@dataclass(frozen=True)
class Default:
    """Rule for an open setting: `value` of the section so far and the evidence; by: in words."""

    value: Callable[[TrainSection, Evidence], Any]
    by: str


def _feature_every(_: TrainSection, evidence: Evidence) -> int:
    """Features in one step of four are as accurate as in each, for less than half of their time.

    With few views they also regularise the Gaussians (ten views: 24.3 dB; one step of four: 23.1).
    """
    return min(max(evidence.n_views // 10, 1), 4)


def _feature_start(_: TrainSection, evidence: Evidence) -> str:
    """Zero for few views: features from the first step then make Gaussians overfit single views.

    Six, ten and twenty views of one room lose 3.6, 3.6 and 1.0 dB by them; seventy none.
    """
    return "lifted" if evidence.n_views >= LIFTED_FROM else "zero"


def _by_steps(published: float, power: float) -> Default:
    """A learning rate of 3DGS, raised for fewer steps.

    Powers are from 1000-step trainings of office0 and fox, where means 8 times, scales and
    rotations 3 times and colours 4 times as fast were best on held-out training views; from 30,000
    steps on the rate is 3DGS's.
    """

    def rate(train: TrainSection, _: Evidence) -> float:
        assert train.steps is not None
        return published * max(PUBLISHED / max(train.steps, FEWEST_STEPS), 1) ** power

    return Default(
        rate, f"steps, taken as {FEWEST_STEPS} to 30,000: {published:g} (30,000 / steps)^{power:g}"
    )


def _features_rate(train: TrainSection, _: Evidence) -> float:
    assert train.steps is not None and train.feature_every is not None
    return min(TRAVEL / max(train.steps // train.feature_every, 1), FASTEST)


def _exposure(_: TrainSection, evidence: Evidence) -> str:
    spread = evidence.exposure_spread
    return "off" if spread is None or spread < LEAST_SPREAD else "measured"


DEFAULTS = {  # in this order: a later one may depend on an earlier
    "steps": Default(
        lambda _, evidence: default_steps(evidence.n_pixels),
        "pixels of the training photos: 280 a megapixel, from 1000 to 3000",
    ),
    "max_gaussians": Default(
        lambda _, evidence: default_gaussians(evidence.n_pixels, evidence.points_measured),
        "initial points: 40,000 if from measured depth, otherwise 100,000; above 40 million pixels "
        "of training photos more, by the root of their number",
    ),
    "feature_every": Default(
        _feature_every, "training views: a tenth of their number, from 1 to 4"
    ),
    "feature_start": Default(_feature_start, "training views: lifted from 40 on, otherwise zero"),
    "feature_loss": Default(
        lambda _, evidence: "cross-entropy" if evidence.labels == "given" else "length",
        "labels: cross-entropy where the source brings them, otherwise length",
    ),
    "opacity": Default(
        lambda _, evidence: 0.7 if evidence.points_measured else 0.3,
        "initial points: 0.7 where depth is measured, since there is a surface at each, otherwise "
        "0.3",
    ),
    "weight_depth": Default(
        lambda _, evidence: 0.0 if evidence.no_depth else DEPTH_WEIGHT,
        f"depth: {DEPTH_WEIGHT} where there is any and views agree on it to {MOST_APART:.1%}, "
        "otherwise 0",
    ),
    "exposure": Default(
        _exposure,
        f"photos: measured where their exposures deviate by {LEAST_SPREAD} stops or more",
    ),
    "lr_means": _by_steps(1.6e-4, 0.61),
    "lr_scales": _by_steps(5e-3, 0.52),
    "lr_quats": _by_steps(1e-3, 0.52),
    "lr_sh0": _by_steps(2.5e-3, 0.41),
    "lr_sh": _by_steps(1.25e-4, 0.41),
    "lr_features": Default(
        _features_rate, f"steps that teach features: {TRAVEL:g} over them, at most {FASTEST:g}"
    ),
}


WITHOUT: dict[str, dict[str, Any]] = {  # rows of Table 5 that are settings of the trainer
    "densification": {"densify": "off"},
}


def resolved(train: TrainSection, evidence: Evidence) -> TrainSection:
    """The section with every open setting decided, and the printed method's settings in place."""
    if train.method == "printed":
        train = train.model_copy(update=PRINTED | WITHOUT.get(train.without, {}))
    for name, default in DEFAULTS.items():
        if getattr(train, name) in OPEN:
            train = train.model_copy(update={name: default.value(train, evidence)})
    return train


def decided(
    train: TrainSection, final: TrainSection, with_features: bool
) -> dict[str, dict[str, Any]]:
    """Value, of `final`, and reason of each setting that `train` leaves open and that is in use."""
    unused = (
        set()
        if with_features
        else {"feature_every", "feature_start", "feature_loss", "lr_features"}
    )
    unused |= {"opacity"} if train.start else set()
    names = [name for name in DEFAULTS if getattr(train, name) in OPEN and name not in unused]
    printed = PRINTED if train.method == "printed" else {}
    by = {name: "the printed method" if name in printed else DEFAULTS[name].by for name in names}
    return {name: {"value": getattr(final, name), "by": by[name]} for name in names}


def from_measured_depth(points: Points) -> bool:
    """True if points lie on measured surfaces."""
    return points.notes.get("how") == "depth" or "n_from_depth" in points.notes


def n_training_pixels(capture: Capture, points: Points) -> int:
    """Pixels of the training photos, in all."""
    return len(training_rows(capture, points)) * math.prod(capture.size)


def evidence_of(
    train: TrainSection, capture: Capture, points: Points, features: Features | None
) -> Evidence:
    """Evidence for the open settings, but for the photos' exposures; measures only what is needed.

    Raises: ConfigError where the teacher lacks the labels of `train.feature_loss`, InputError if
      capture and points do not belong together, DataFailure without a training view.
    """
    n_views = len(training_rows(capture, points))
    labels = None if features is None else "none"
    if (
        features is not None
        and features.pseudo_labels is not None
        and features.confidence is not None
    ):
        labels = "given" if features.convention.get("kind") == "given" else "taught"
    if train.feature_loss == "cross-entropy" and labels == "none":
        raise ConfigError(
            "train.feature_loss is cross-entropy, but the teacher brings no labels with a "
            "confidence; use length"
        )
    return Evidence(
        n_views=n_views,
        n_pixels=n_training_pixels(capture, points),
        points_measured=from_measured_depth(points),
        no_depth=_why_no_depth(capture, points) if train.weight_depth is None else "",
        labels=labels,
    )


def _why_no_depth(capture: Capture, points: Points) -> str:
    """Reason for not using measured depth ("": it is used).

    Choices: not without poses in the capture, since its unit is not the scene's then, nor where
      views contradict one another, as a sensor's do, whose noise and offset from the colour camera
      would be learned. Swept depth exists only where views agree.
    """
    if capture.depth is None and points.depths is not None:
        return ""
    if capture.depth is None or capture.cam_from_world is None:
        return "the capture has no depth in the unit of its poses"
    apart = disagreement(capture, points)
    if apart <= MOST_APART:
        return ""
    return (
        f"depths of the same points differ by {apart:.1%} between views; train.weight_depth "
        "asks for it"
    )
