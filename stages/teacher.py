"""teacher: per-view semantic features, from the capture's labels through a noise model or from an ONNX model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.stages.command import Job, command

if TYPE_CHECKING:
    from chebsplat.formats.capture import Capture
    from chebsplat.formats.features import Features
    from chebsplat.stages.config import TeacherSection


def run(job: Job) -> None:
    from chebsplat.formats.capture import read_capture
    from chebsplat.formats.features import write_features

    settings, capture = job.config.teacher, read_capture(job.inputs["capture"])
    kind = settings.kind
    if kind == "auto":
        kind = "onnx" if settings.model else "labels" if capture.labels is not None else "none"
    if kind == "none":
        raise ConfigError("this scene has no teacher: no labels, and teacher.model names no ONNX model")
    if kind == "labels":
        features = from_labels(job, capture, settings)
    else:
        from chebsplat.stages.image_encoder import encode_views

        features = encode_views(job, capture, settings)
    job.facts |= {"kind": kind, "n_labels": len(features.label_names), "convention": features.convention}
    write_features(job.out, features)


def from_labels(job: Job, capture: Capture, settings: TeacherSection) -> Features:
    """Pseudo labels of known error (METHOD section 9). Every view draws from its own generator, seeded by its name."""
    import hashlib

    import numpy as np

    from chebsplat import noisy_teacher as model
    from chebsplat.codes import class_codes
    from chebsplat.formats.features import Features

    if capture.labels is None or not capture.class_names:
        raise DataFailure("the capture has no labels; set teacher.model to an ONNX model, or teacher.kind = none")
    codes = class_codes(capture.class_names, settings.n_channels)
    training = np.flatnonzero(~capture.is_test)
    images, labels = np.asarray(capture.images[:])[training], np.asarray(capture.labels[:])[training]
    probabilities = model.confusable(model.class_colors(images, labels, len(codes)))
    rows = []
    for view, _ in job.progress.track(range(len(capture.names)), len(capture.names), "teacher"):
        name = hashlib.sha256(capture.names[view].encode()).digest()
        generator = np.random.default_rng([settings.seed, int.from_bytes(name[:8], "big")])
        small = model.reduced(capture.labels[view], settings.downscale)
        confused = model.confuse_segments(small, probabilities, settings.confusion, generator)
        rows.append(model.noisy_features(confused, codes, settings.blur, settings.noise, generator).astype(np.float16))
    features = np.stack(rows)
    pseudo, confidence = model.decode(features.astype(np.float32), codes)
    convention = {"kind": "labels", "normalized": True, "n_scales": 1, "flips": False} | settings.model_dump(
        mode="json", include={"downscale", "confusion", "blur", "noise", "seed", "n_channels"}
    )
    return Features(capture.names, features, capture.class_names, codes, pseudo, confidence, convention)


main = command("teacher", run)
