"""refine: the features of a finished scene, smoothed, and blended with knowledge as far as its training views ask."""

from __future__ import annotations

from typing import Any

import numpy as np

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.lifted import Lifted, Refined
from chebsplat.formats.points import Points
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import blend, calibrate, confidence, effective, familiar, reliable, start, trusted
from chebsplat.lifting.observations import carry
from chebsplat.lifting.smoothing import affinities, room_unit, smooth
from chebsplat.splats.gaussians import surface_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.shape_models.predictions import known_shapes, measured, shown, swept

REACH = 0.15  # metres from swept points, where an answer is half as long
LEAST_TOLD = 0.5  # of the pixels of a capture without depth, which a sweep must have found
METRIC = ("generated", "replica", "scannet", "seven_scenes")  # sources whose scene unit is the metre


def run(job: Job) -> None:
    """Smooth the features of trained Gaussians, then blend them with knowledge (docs/method.md, section 13).

    Reads `gaussians` and `lifted`, for the scene's unit `capture`, for what knowledge says `knowledge`, `points` and
    `features`, by which the share of labels that change is counted, too. Writes `refined`.
    """
    settings = job.config.refine
    gaussians, lifted = Gaussians.read(job.inputs["gaussians"]), Lifted.read(job.inputs["lifted"])
    p = gaussians.parameters
    if len(p["means"]) == 0:
        raise DataFailure("the checkpoint holds no Gaussians; train the scene again with milder pruning")
    if len(lifted.features) != len(p["means"]):
        raise InputError(
            f"{job.inputs['lifted']} is of {len(lifted.features)} Gaussians, not {len(p['means'])}; lift again"
        )
    trained = p.get("features")
    capture = Capture.read(job.inputs["capture"]) if "capture" in job.inputs else None
    started = settings.start
    if started == "auto":  # Gaussians that no depth has placed lie where they look right, which lifting asks nothing of
        started = "both" if capture is None or capture.depth is not None else "trained"
    if trained is None:
        started = "lifted"
        if settings.start != started:
            job.left_out("trained features", "the scene was trained without; the lifted ones are refined")
    features = start(started, lifted.features, trained)
    unit = scene_unit(job, capture, p["means"])
    near = affinities(p["means"], *surface_of(p), unit)
    knowledge = known(job, gaussians, capture, unit)
    choice = calibrate(lifted.halves, lifted.half_views, near, knowledge)
    smoothed = choice.smooth if settings.smooth == "auto" else settings.smooth == "on"
    strength = choice.strength
    known_to_teacher = 1.0
    made = [features, smooth(features, lifted.n_views, near) if smoothed else features]
    made.append(made[1])
    if knowledge is not None:
        known_to_teacher = familiar(lifted.features, knowledge, Features.read(job.inputs["features"]).label_embeddings)
        evidence = effective(lifted.n_views) * reliable(lifted.halves, lifted.half_views) * known_to_teacher
        blended = blend(made[1], evidence, knowledge, strength)
        made[2] = smooth(blended, evidence + trusted(knowledge, strength), near) if smoothed else blended
    curve = {name: {f"{k:g}": value for k, value in row.items()} for name, row in choice.curve.items()}
    notes = {"start": started, "smooth": smoothed, "strength": strength, "familiar": known_to_teacher, "curve": curve}
    sure = confidence(made[1], lifted.n_views, lifted.agreement, knowledge, strength, known_to_teacher)
    Refined(made[2], sure, notes).write(job.out)
    job.facts |= {"n_gaussians": len(features), "unit": unit, **notes} | shares(job, made)


def known(job: Job, gaussians: Gaussians, capture: Capture | None, unit: float) -> np.ndarray | None:
    """What knowledge of shape says of the Gaussians, f32 [N, C]: of the points beside them.

    Choices: points are those of the capture's depth, otherwise of the depth that a sweep of its photos found, and then
      an answer's length, by which it counts, falls with the distance to them: what no photo's depth shows is the views'
      to tell. Without either knowledge is left out by default: Gaussians that ten photos have placed show a surface on
      which shape alone is right for half of them.
    """
    if "knowledge" not in job.inputs:
        return None
    if absent := [role for role in ("points", "features") if role not in job.inputs]:
        raise ConfigError(f"knowledge is of points and a teacher; pass --in-{absent[0]}, too")
    points, features = Points.read(job.inputs["points"]), Features.read(job.inputs["features"])
    p, cameras = gaussians.parameters, gaussians.cameras
    source = "rendered depth" if job.config.refine.surface == "rendered" else "swept depth"
    if capture is None or capture.depth is not None:
        source = "points"
    elif source == "swept depth" and (why := untold(capture, points)):
        job.left_out("knowledge of shape", why)
        return None
    try:
        if source == "points":
            cloud = measured(points)
        elif source == "swept depth":
            cloud = swept(points, cameras.width, unit)
        else:
            assert capture is not None
            test = {name for name, is_test in zip(capture.names, capture.is_test, strict=True) if is_test}
            rows = [row for row, name in enumerate(cameras.names) if name not in test]
            size = cameras.width, cameras.height
            cloud = shown(p, cameras.cam_from_world[rows], cameras.Ks[rows], size, unit)
        answers, facts = known_shapes(job.inputs["knowledge"], features, cloud, points.cam_from_world, unit)
    except DataFailure as error:
        job.left_out("knowledge of shape", str(error))
        return None
    carried, away = carry(answers, cloud.means, cloud.normals, p["means"], surface_of(p)[0], unit)
    if source == "swept depth":
        carried *= 1 / (1 + (away[:, None] / unit / REACH) ** 2)
    job.facts["knowledge"] = facts | {"of": source, "n_points": len(cloud.means)}
    return carried


def untold(capture: Capture, points: Points) -> str:
    """Why shape cannot be told of a capture without depth; "": it can.

    Choices: where fewer than half of the pixels have swept depth, things stand alone that walls surround: shape was
      right for 70 % of what is near its points, where smoothed features were for 82 % (two rooms, ten photos each).
    """
    if points.depths is None:
        return "the capture has no depth, and what Gaussians show without it misleads"
    row = {name: view for view, name in enumerate(capture.names)}
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    share = float(np.mean(points.depths[used] > 0)) if used else 0.0
    if share >= LEAST_TOLD:
        return ""
    return f"the capture has no depth, and a sweep of its photos finds that of {share:.0%} of their pixels: too little"


def scene_unit(job: Job, capture: Capture | None, means: np.ndarray) -> float:
    """Scene units of a metre: 1 where the source is metric or has depth, otherwise by the extent; facts say which."""
    metric = capture is not None and (capture.depth is not None or capture.source.get("kind") in METRIC)
    job.facts["unit_from"] = "source" if metric else "extent"
    return 1.0 if metric else room_unit(means)


def shares(job: Job, made: list[np.ndarray]) -> dict[str, Any]:
    """Share of the Gaussians whose label smoothing changes, and knowledge after it."""
    if "features" not in job.inputs:
        return {}
    embeddings = Features.read(job.inputs["features"]).label_embeddings
    if embeddings.shape[1] != made[0].shape[1]:
        raise InputError(f"{job.inputs['features']} has other channels than the checkpoint; pass its own")
    labels = [decode_labels(features, embeddings) for features in made]
    names = ("changed_by_smoothing", "changed_by_knowledge")
    return {name: float((a != b).mean()) for name, a, b in zip(names, labels, labels[1:], strict=False)}
