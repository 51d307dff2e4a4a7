"""train: the semantic Gaussian scene (Eqs 11-13), with its trace of error against run time."""

from __future__ import annotations

import logging
from typing import Any

from chebsplat.errors import DataFailure
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.world import World
from chebsplat.kernels.dispatch import one_torch_thread
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.training.assembly import KNOWLEDGE, assemble, read_inputs
from chebsplat.stages.training.facts import facts_of, printed_facts
from chebsplat.stages.training.loop import follow
from chebsplat.stages.training.truth import labels_right
from chebsplat.training.printed import PrintedScene

log = logging.getLogger("chebsplat")


@one_torch_thread()  # or as many as `assemble` says; afterwards as many as before
def run(job: Job) -> None:
    """Optimise Gaussians and their semantics (Eqs 11-13; docs/method.md, sections 3 to 8).

    Reads `capture`, `points` and, with semantics, `features`; in a sequence, the `gaussians` of the
    scene before. Writes `gaussians`.
    """
    inputs = read_inputs(job)
    trainer = assemble(job, inputs)
    points, features, n_initial = inputs.points, inputs.features, len(trainer.model)
    trace = follow(job, trainer)
    printed = trainer.model if isinstance(trainer.model, PrintedScene) else None
    if printed is not None and features is not None:
        job.facts["printed"] = printed_facts(printed, features)
    bases = {} if printed is None else printed.grown_bases()
    parameters, population = trainer.finish(), trainer.population
    if population.n_broken:
        log.warning("%d Gaussians became non-finite and were removed", population.n_broken)
    if parameters["degrees"].size == 0:
        raise DataFailure(
            "no Gaussian is left; lower train.weight_mask or raise train.min_gaussians"
        )
    job.facts |= facts_of(job, trainer, parameters) | {"psnr": trace[-1]["psnr"]}
    if features is not None and "features" in parameters:
        job.facts["right"] = labels_right(
            inputs.capture, parameters, parameters["features"], features
        )
    modules = {
        f"{n}.{k}": v.detach().cpu().numpy()
        for n, m in trainer.model.modules.items()
        for k, v in m.state_dict().items()
    }
    modules |= {KNOWLEDGE + name: basis.numpy() for name, basis in bases.items()}
    exposures = inputs.exposures if trainer.settings.exposure == "measured" else None
    cameras = Cameras(
        points.names,
        points.Ks,
        points.cam_from_world,
        *inputs.capture.size,
        None if exposures is None else exposures.expected,
    )
    notes: dict[str, Any] = {
        "left_out": job.facts.get("left_out", {}),
        "n_added": population.n_added,
    }
    notes |= World.read(inputs.capture.source).notes
    notes |= {
        "n_removed": population.n_removed,
        "n_broken": population.n_broken,
        "n_initial": n_initial,
    }
    if features is not None:
        notes |= {"label_names": features.label_names, "convention": features.convention}
    Gaussians(parameters, cameras, modules, trace, notes).write(job.out)
