"""refine: the features of a finished scene, smoothed and blended with knowledge where its training views agree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.command import Job, command

if TYPE_CHECKING:
    import numpy as np

METRIC = ("generated", "replica", "scannet", "seven_scenes")  # sources whose scene unit is the metre


def run(job: Job) -> None:
    """Smooth the features of trained Gaussians, then blend them with knowledge (docs/method.md, section 13).

    Reads `gaussians` and `lifted`, for the scene's unit `capture`, and for the share of labels that change `features`.
    Writes `refined`.
    """
    from chebsplat.formats.gaussians import read_gaussians
    from chebsplat.formats.lifted import read_lifted
    from chebsplat.formats.refined import Refined, write_refined
    from chebsplat.lifting.blend import blend, calibrate, confidence
    from chebsplat.lifting.smoothing import affinities, smooth
    from chebsplat.splats.gaussians import surface_of

    settings = job.config.refine
    gaussians, lifted = read_gaussians(job.inputs["gaussians"]), read_lifted(job.inputs["lifted"])
    p = gaussians.parameters
    if len(p["means"]) == 0:
        raise DataFailure("the checkpoint holds no Gaussians; train the scene again with milder pruning")
    if len(lifted.features) != len(p["means"]):
        raise InputError(
            f"{job.inputs['lifted']} is of {len(lifted.features)} Gaussians, not {len(p['means'])}; lift again"
        )
    started, features = settings.start, p.get("fused", p.get("features"))
    if started == "trained" and features is None:
        job.left_out("trained features", "the scene was trained without; the lifted ones are refined")
        started = "lifted"
    if started == "lifted" or features is None:
        features = lifted.features
    unit = scene_unit(job, p["means"])
    near = affinities(p["means"], *surface_of(p), unit)
    knowledge: np.ndarray | None = None  # [N, C], where an earlier scene or `knowledge` has some
    choice = calibrate(lifted.halves, lifted.half_views, near, knowledge)
    smoothed = choice.smooth if settings.smooth == "auto" else settings.smooth == "on"
    strength = choice.best_strength(smoothed)
    made = [features, smooth(features, lifted.n_views, near) if smoothed else features]
    made.append(made[1] if knowledge is None else blend(made[1], lifted.n_views, knowledge, strength))
    curve = {name: {f"{k:g}": value for k, value in row.items()} for name, row in choice.curve.items()}
    notes = {"start": started, "smooth": smoothed, "strength": strength, "curve": curve}
    known = confidence(made[1], lifted.n_views, lifted.agreement, knowledge, strength)
    write_refined(job.out, Refined(made[2], known, notes))
    job.facts |= {"n_gaussians": len(features), "unit": unit, **notes} | shares(job, made)


def scene_unit(job: Job, means: np.ndarray) -> float:
    """Scene units of a metre: 1 where the source is metric, otherwise by the scene's extent, which facts say."""
    from chebsplat.formats.capture import read_capture
    from chebsplat.lifting.smoothing import room_unit

    kind = read_capture(job.inputs["capture"]).source.get("kind") if "capture" in job.inputs else None
    job.facts["unit_from"] = "source" if kind in METRIC else "extent"
    return 1.0 if kind in METRIC else room_unit(means)


def shares(job: Job, made: list[np.ndarray]) -> dict[str, Any]:
    """Share of the Gaussians whose label smoothing changes, and knowledge after it."""
    from chebsplat.formats.features import read_features
    from chebsplat.labels.decode import decode_labels

    if "features" not in job.inputs:
        return {}
    embeddings = read_features(job.inputs["features"]).label_embeddings
    if embeddings.shape[1] != made[0].shape[1]:
        raise InputError(f"{job.inputs['features']} has other channels than the checkpoint; pass its own")
    labels = [decode_labels(features, embeddings) for features in made]
    names = ("changed_by_smoothing", "changed_by_knowledge")
    return {name: float((a != b).mean()) for name, a, b in zip(names, labels, labels[1:], strict=False)}


main = command("refine", run)
