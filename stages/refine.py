"""refine: blend the features of a finished scene with knowledge of shape, and smooth them."""

from __future__ import annotations

from typing import Any

import numpy as np

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import read_knowledge
from chebsplat.formats.lifted import Lifted, Refined
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import (
    Shape,
    believed,
    blend,
    confidence,
    effective,
    errors_alike,
    familiar,
    halves_agree,
    labels_agree,
    reliable,
    start,
    strength_of,
    supported,
    trusted,
)
from chebsplat.lifting.observations import carry
from chebsplat.lifting.smoothing import affinities, smooth
from chebsplat.splats.gaussians import surface_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.answers import answering, into_channels, unnamed
from chebsplat.stages.shape_models.surfaces import in_scene, scene_unit
from chebsplat.stages.training.truth import labels_right

REACH = 0.15  # metres from swept points, where an answer is half as long


def run(job: Job) -> None:
    """Blend knowledge into features of Gaussians, and smooth (docs/method.md, section 13).

    Reads `gaussians` and `lifted`; for the scene's unit `capture`; for knowledge `knowledge`,
    `descriptors`, `encoding` and `features`, by which the share of labels that change is counted,
    too. Writes `refined`.
    """
    settings = job.config.refine
    gaussians, lifted = Gaussians.read(job.inputs["gaussians"]), Lifted.read(job.inputs["lifted"])
    p = gaussians.parameters
    if len(p["means"]) == 0:
        raise DataFailure(
            "the checkpoint holds no Gaussians; train the scene again with milder pruning"
        )
    if len(lifted.features) != len(p["means"]):
        raise InputError(
            f"{job.inputs['lifted']} is of {len(lifted.features)} Gaussians, not "
            f"{len(p['means'])}; lift again"
        )
    teacher = Features.read(job.inputs["features"]) if "features" in job.inputs else None
    if teacher is not None and teacher.label_embeddings.shape[1] != lifted.features.shape[1]:
        raise InputError(
            f"{job.inputs['features']} has other channels than the checkpoint; pass its own"
        )
    trained = p.get("features")
    capture = Capture.read(job.inputs["capture"]) if "capture" in job.inputs else None
    started = settings.start
    # without depth Gaussians may lie off the surface, and lifted features with them
    if started == "auto":
        started = "both" if capture is None or capture.depth is not None else "trained"
    if trained is None:
        started = "lifted"
        if settings.start != started:
            job.left_out(
                "trained features", "the scene was trained without; the lifted ones are refined"
            )
    features = start(started, lifted.features, trained)
    unit, job.facts["unit_from"] = scene_unit(capture, p["means"])
    near = affinities(p["means"], *surface_of(p), unit)
    shape = predict_from_shape(job, p, unit)
    alike = errors_alike(lifted.agreement, lifted.halves, lifted.half_views)
    each = list(zip(lifted.halves, lifted.half_views, strict=True))
    smoothed_halves = [smooth(*half, near) for half in each]
    as_they_are, smoother = (
        halves_agree(lifted.halves, lifted.half_views, of) for of in (None, smoothed_halves)
    )
    smoothed = smoother > as_they_are if settings.smooth == "auto" else settings.smooth == "on"
    notes: dict[str, Any] = {"start": started, "smooth": smoothed, "strength": 0.0, "alike": alike}
    strength, known_to_teacher, knowledge = 0.0, 1.0, None
    if shape is not None:
        known_to_teacher = familiar(lifted.features, shape.answers, shape.embeddings)
        support = supported(lifted.features, lifted.n_views, lifted.agreement, shape)
        belief = believed(lifted.features, lifted.n_views, shape, known_to_teacher)
        strength = strength_of(support, known_to_teacher, belief)
        notes |= {"strength": strength, "supported": support, "believed": belief}
        knowledge = shape.beside(features)
    notes["familiar"] = known_to_teacher
    reliability = reliable(lifted.halves, lifted.half_views) * known_to_teacher

    def refine(of: np.ndarray, n_views: np.ndarray) -> np.ndarray:
        """Features by so many views, blended and smoothed as was decided."""
        if shape is None or strength == 0:
            return smooth(of, n_views, near) if smoothed else of
        answers, evidence = shape.beside(of), effective(n_views, alike) * reliability
        blended = blend(of, evidence, answers, strength)
        return smooth(blended, evidence + trusted(answers, strength), near) if smoothed else blended

    alone = smooth(features, lifted.n_views, near) if smoothed else features
    refined = refine(features, lifted.n_views)
    halves = [refine(*half) for half in each]
    sure = confidence(
        alone, lifted.n_views, lifted.agreement, knowledge, strength, known_to_teacher, alike
    )
    if teacher is not None:
        agreed, without, after = (
            labels_agree(lifted.halves, lifted.half_views, teacher.label_embeddings, of)
            for of in (None, smoothed_halves if smoothed else None, halves)
        )
        if agreed is not None and after is not None:
            job.facts |= {"labels_agree": after, "gain": after - agreed}
            if strength > 0:
                notes["halves"] = {"without": without, "with": after}
    Refined(refined, sure, notes).write(job.out)
    if capture is not None and teacher is not None:
        job.facts["right"] = labels_right(capture, p, refined, teacher)
    job.facts |= {"n_gaussians": len(features), "unit": unit, **notes}
    if teacher is not None:
        job.facts |= changed_by([features, alone, refined], teacher.label_embeddings)


def predict_from_shape(job: Job, parameters: dict[str, np.ndarray], unit: float) -> Shape | None:
    """Features of the Gaussians that knowledge predicts from the shape at the described points
    beside them; None where the scene has no knowledge, or none of it applies.

    Args: parameters: of the Gaussians; unit: scene units in a metre.
    Raises: ConfigError where an input that knowledge needs is missing.
    Choices: the length of a prediction is its weight. It falls with the distance to swept points:
      where no photo has depth, the views decide.
    """
    if "knowledge" not in job.inputs:
        return None
    if absent := [
        role for role in ("descriptors", "encoding", "features") if role not in job.inputs
    ]:
        raise ConfigError(
            f"knowledge is of described points and a teacher; pass --in-{absent[0]}, too"
        )
    descriptors = Descriptors.read(job.inputs["descriptors"])
    encoding = Encoding.read(job.inputs["encoding"])
    if not len(encoding.features):
        job.left_out("knowledge of shape", encoding.notes["none"])
        return None
    path, features = job.inputs["knowledge"], Features.read(job.inputs["features"])
    knowledge = read_knowledge(path)
    if missing := unnamed(knowledge, features):
        job.left_out(
            "votes of shape on some labels", f"knowledge has no word for {', '.join(missing)}"
        )
    try:
        translated = into_channels(path, knowledge, features)
    except DataFailure as error:
        job.left_out("knowledge of shape", str(error))
        return None
    means, normals = in_scene(descriptors)
    answers = translated(encoding.features.astype(np.float32) @ knowledge.map)
    carried, away = carry(
        answers, means, normals, parameters["means"], surface_of(parameters)[0], unit
    )
    if descriptors.notes["of"] == "swept depth":
        carried *= 1 / (1 + (away[:, None] / unit / REACH) ** 2)
    shape = answering(path, knowledge, features, carried)
    names, confusions = features.label_names, shape.confused_with
    confused = {names[k]: names[to] for k, to in enumerate(confusions) if to != k}
    if confused:
        pairs = ", ".join(f"{name} for {other}" for name, other in confused.items())
        job.left_out("votes of shape against some labels", f"knowledge takes {pairs}")
    job.facts["knowledge"] = {
        "of": descriptors.notes["of"],
        "n_points": len(means),
        "lessons": knowledge.lessons,
        "confused": confused,
    }
    return shape


def changed_by(steps: list[np.ndarray], embeddings: np.ndarray) -> dict[str, float]:
    """Share of the Gaussians whose label smoothing changes, and that knowledge changes beyond it.

    Args: steps: features without either, smoothed, and with both; embeddings [L, C] of labels.
    """
    labels = [decode_labels(features, embeddings) for features in steps]
    names = ("changed_by_smoothing", "changed_by_knowledge")
    return {
        name: float((a != b).mean()) for name, a, b in zip(names, labels, labels[1:], strict=False)
    }
