"""export: the trained scene as PLY and SPZ, ragged arrays, a label dictionary and a summary."""

from __future__ import annotations

from typing import Any

import numpy as np

from chebsplat.cameras import centers
from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.lifted import Lifted, Refined
from chebsplat.formats.scene import Scene
from chebsplat.formats.world import World
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.dictionary import shared_features
from chebsplat.splats.rounded import rounded_light
from chebsplat.stages.runtime.command import Job


def run(job: Job) -> None:
    """The trained Gaussians in order of SH degree, each with its label.

    Reads `gaussians`, for names of labels `features` and, in place of trained features, `refined`
    or `lifted`. Writes `scene`.

    Choices: Gaussians share the features of a dictionary, which labels also come from. A Gaussian
      that no training view sees has lifted features of zero: no label, and no part in rendered
      features.
    """
    gaussians = Gaussians.read(job.inputs["gaussians"])
    if len(gaussians.parameters["means"]) == 0:
        raise DataFailure(
            "the checkpoint holds no Gaussians; train the scene again with milder pruning"
        )
    order = np.argsort(gaussians.parameters["degrees"], kind="stable")
    fields = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN", "degrees")
    parameters = {name: gaussians.parameters[name][order] for name in fields}
    semantic = later_features(job, len(order))
    if semantic is None:
        semantic = gaussians.parameters.get("features")
    labelled: dict[str, Any] = {}
    if semantic is None:
        job.left_out("labels", "the scene was trained without semantics")
    elif "features" not in job.inputs:
        job.left_out("labels", "no --in-features: the label embeddings are unknown")
    else:
        teacher = Features.read(job.inputs["features"])
        if semantic.shape[1] != teacher.label_embeddings.shape[1]:
            raise InputError(
                f"{job.inputs['features']} has other channels than the checkpoint; pass its own"
            )
        parameters["features"] = shared_features(semantic[order])
        labels = decode_labels(parameters["features"], teacher.label_embeddings).astype(np.int32)
        labels[~parameters["features"].any(1)] = -1
        labelled = {
            "labels": labels,
            "label_names": teacher.label_names,
            "label_embeddings": teacher.label_embeddings,
        }
    counts = np.bincount(parameters["degrees"], minlength=4).tolist()
    for degree in range(int(parameters["degrees"].max(initial=0)) + 1, 4):
        job.left_out(f"SH band {degree}", "no Gaussian keeps it")
    left_out = gaussians.notes.get("left_out", {}) | job.facts.get("left_out", {})
    summary = {
        "left_out": left_out,
        "by_degree": counts,
        "n_initial": gaussians.notes.get("n_initial"),
    }
    summary |= World.read(gaussians.notes).notes
    scene = Scene(parameters, gaussians.cameras, order, **labelled, summary=summary)
    eyes = centers(gaussians.cameras.cam_from_world)
    sizes = scene.write(job.out, rounded_light(parameters, eyes))
    job.facts |= {"n_gaussians": len(order), "by_degree": counts, "bytes": sizes}


def later_features(job: Job, n: int) -> np.ndarray | None:
    """Features [n, C] refined, or else lifted, after training; None where neither is an input."""
    records: dict[str, type[Refined | Lifted]] = {"refined": Refined, "lifted": Lifted}
    role = next((role for role in records if role in job.inputs), None)
    if role is None:
        return None
    features: np.ndarray = records[role].read(job.inputs[role]).features
    if len(features) != n:
        raise InputError(
            f"{job.inputs[role]} is of {len(features)} Gaussians, not these {n}; make it again"
        )
    return features
