"""teacher: per-view semantic features, of labels through a noise model or of an ONNX model."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.formats.artifact import read_manifest, sha256_file
from chebsplat.formats.capture import Capture
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.features import Features, FeatureWriter
from chebsplat.formats.onnx_files import model_sha256
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.kernels.threads import n_threads
from chebsplat.labels import noisy_teacher as model
from chebsplat.labels.decode import class_codes, decode, voted
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import MAX_CHANNELS, TeacherSection
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.stages.teacher_models.label_space import closed_set, label_set, open_vocabulary
from chebsplat.stages.teacher_models.onnx_session import CUDA, GPU_REMEDY, providers
from chebsplat.stages.training.truth import pixels_right

log = logging.getLogger("chebsplat")
MIRRORED = 25  # one of so many views is encoded mirrored, too: 4 % of the stage's time


def run(job: Job) -> None:
    """A 2D teacher's features, labels and confidences of all views (docs/method.md, section 9).

    Reads `capture` and, where an ONNX teacher's channels are reduced, `channels`. Writes
    `features`.
    """
    settings, capture = job.config.teacher, Capture.read(job.inputs["capture"])
    if settings.kind == "none":
        raise ConfigError("teacher.kind is none: this scene has no teacher; leave the stage out")
    if settings.kind in ("labels", "given"):
        make = from_labels if settings.kind == "labels" else from_pseudo_labels
        features = make(job, capture, settings)
        job.facts |= {
            "kind": settings.kind,
            "n_labels": len(features.label_names),
            "convention": features.convention,
        }
        job.facts["right"] = pixels_right(capture, features)
        features.write(job.out)
    else:
        from_onnx(job, capture, settings)


def from_onnx(job: Job, capture: Capture, settings: TeacherSection) -> None:
    """Write features of every view by an ONNX model, by default the embedded one; resumes.

    Choices: test views are encoded too, because evaluate reports the teacher's own figures on them.
    """
    teacher = read_teacher(Path(settings.model) if settings.model else EMBEDDED)
    network = TeacherInference(teacher, n_threads(), job.device)
    if job.device == "cuda" and CUDA not in providers(job.device):
        why = f"onnxruntime here has no CUDA ({GPU_REMEDY})"
        job.left_out("the teacher on the GPU", why)
        log.info("the teacher runs on the CPU: %s", why)
    if teacher.guessed:
        log.info(
            "%s has no `output`: logits, as %s holds names alone", teacher.settings, teacher.labels
        )
    grid, n_channels = network.grid(capture.images[0], settings.downscale)
    channels = None
    if teacher.output == "logits":
        labels = label_set(teacher, settings.labels, None) if settings.labels else None
        network.judge(capture.images)
        shares = network.class_shares(capture.images, grid)
        space = closed_set(teacher, labels, shares, settings.n_channels)
        if space.left_out:
            job.left_out(
                "classes of outdoors", f"the views are of a room: {', '.join(space.left_out)}"
            )
    else:
        if "channels" in job.inputs:
            channels = ChannelMap.read(job.inputs["channels"])
        elif n_channels > MAX_CHANNELS:
            raise ConfigError(
                f"{teacher.path} has {n_channels} channels, at most {MAX_CHANNELS} can be "
                "rendered; use `chebsplat run`, or reduce them with `chebsplat channels` and pass "
                "--in-channels"
            )
        labels = label_set(teacher, settings.labels, capture.class_names)
        space = open_vocabulary(teacher, labels, n_channels, channels)
    convention = {
        "kind": "onnx",
        "teacher": teacher.name,
        "sha256": model_sha256(teacher.path),
        "output": teacher.output,
        "scores": network.scores if teacher.output == "logits" else None,
        "normalized": True,  # before `channels`
        "n_scales": len(settings.scales),
        "scales": list(settings.scales),
        "flips": settings.flips,
        "stride": [side / n for side, n in zip(capture.images.shape[1:3], grid, strict=True)],
    }
    made_with = {
        "capture": read_manifest(job.inputs["capture"]).key,
        "channels": read_manifest(job.inputs["channels"]).key if channels else None,
        "teacher": [sha256_file(path) for path in teacher.files()],
        "labels": labels,
        "names": space.names,
        "convention": convention,
    }
    shape = (*grid, space.embeddings.shape[1])
    writer = FeatureWriter(job.scratch / "features", capture.names, shape, made_with)
    waiting = [view for view in range(len(capture.names)) if view not in writer.finished]
    if writer.finished:
        job.watch.go_on(job.scratch)
        log.info(
            "%d of %d views are there from a run that was stopped",
            len(writer.finished),
            len(capture.names),
        )
    for view, _ in job.progress.track(waiting, len(capture.names), "teacher", len(writer.finished)):
        name = capture.names[view]
        features = network.features(
            capture.images[view], grid, settings.scales, settings.flips, name
        )
        writer.add(view, *space.split(features))
        job.watch.keep(job.scratch)
    record = writer.finish(job.out, space.names, space.embeddings, convention, channels)
    assert record.pseudo_labels is not None  # `split` gives them
    alike = []
    for view in range(MIRRORED // 2, len(capture.names), MIRRORED):
        image, upright = capture.images[view], np.asarray(record.pseudo_labels[view])
        once = (grid, settings.scales, False, capture.names[view])
        if settings.flips:
            upright = space.split(network.features(image, *once))[1]
        mirrored = space.split(network.features(image[:, ::-1], *once))[1]
        alike.append(float((upright == mirrored[:, ::-1]).mean()))
    job.facts |= {"kind": "onnx", "n_labels": len(space.names), "convention": convention}
    job.facts |= {
        "mirrored_alike": float(np.mean(alike)) if alike else None,
        "right": pixels_right(capture, record),
    }


def from_labels(job: Job, capture: Capture, settings: TeacherSection) -> Features:
    """Pseudo labels of known error (docs/method.md, section 9).

    Every view draws from its own generator, seeded by its name.
    """
    if capture.labels is None or not capture.class_names:
        raise DataFailure(
            "the capture has no labels; use teacher.kind = auto (the embedded "
            "teacher, or teacher.model)"
        )
    codes = class_codes(capture.class_names, settings.n_channels)
    training = np.flatnonzero(~capture.is_test)
    images = np.asarray(capture.images[:])[training]
    labels = np.asarray(capture.labels[:])[training]
    probabilities = model.confusable(model.class_colors(images, labels, len(codes)))
    rows = []
    for view, _ in job.progress.track(range(len(capture.names)), len(capture.names), "teacher"):
        name = hashlib.sha256(capture.names[view].encode()).digest()
        generator = np.random.default_rng([settings.seed, int.from_bytes(name[:8], "big")])
        small = model.reduced(capture.labels[view], settings.downscale)
        confused = model.confuse_segments(small, probabilities, settings.confusion, generator)
        rows.append(
            model.noisy_features(confused, codes, settings.blur, settings.noise, generator).astype(
                np.float16
            )
        )
    features = np.stack(rows)
    pseudo, confidence = decode(features.astype(np.float32), codes)
    ignored = ~features.any(-1)
    pseudo[ignored], confidence[ignored] = model.IGNORE, 0.0
    convention = {
        "kind": "labels",
        "normalized": True,
        "n_scales": 1,
        "flips": False,
    } | settings.model_dump(
        mode="json", include={"downscale", "confusion", "blur", "noise", "seed", "n_channels"}
    )
    return Features(
        capture.names, features, capture.class_names, codes, pseudo, confidence, convention
    )


def from_pseudo_labels(job: Job, capture: Capture, settings: TeacherSection) -> Features:
    """A 2D network's labels of the views, from the source, weighted by their confidence."""
    if capture.pseudo_labels is None or capture.confidence is None or not capture.class_names:
        raise DataFailure(
            "the capture has no pseudo labels with confidences; use teacher.kind = auto"
        )
    codes = class_codes(capture.class_names, settings.n_channels)
    views = []
    for view, _ in job.progress.track(range(len(capture.names)), len(capture.names), "teacher"):
        views.append(
            voted(capture.pseudo_labels[view], capture.confidence[view], codes, settings.downscale)
        )
    features, labels, confidence = (np.stack(parts) for parts in zip(*views, strict=True))
    convention = {
        "kind": "given",
        "normalized": True,
        "n_scales": 1,
        "flips": False,
        "downscale": settings.downscale,
    }
    half = features.astype(np.float16), labels, confidence.astype(np.float16)
    return Features(capture.names, half[0], capture.class_names, codes, *half[1:], convention)
