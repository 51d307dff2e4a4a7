"""cks: the next revision of the core knowledge space (Eqs 14-15). The old one is never changed."""

from __future__ import annotations

from typing import Any

import torch

from chebsplat.errors import DataFailure
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.basis import Basis, read_basis, write_basis
from chebsplat.formats.gaussians import Gaussians
from chebsplat.settings import DescribeSection
from chebsplat.shape.cks import Growth, spread, update
from chebsplat.shape.refresh import Descriptors
from chebsplat.shape.regions import regions_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.training.saves import restored_encoder, trained_with, without_basis

GEOMETRY = ("means", "quats", "log_scales")
KAPPA = 1.0  # κ of ρ′ = ρ (1 + κ σ_f) in Eq 15: what the spread of shape within regions counts


def run(job: Job) -> None:
    """Extend the knowledge space by what it misses of a scene's encoder (Eq 15; docs/method.md, section 7).

    Reads `gaussians` and, after the first scene of a sequence, the `basis` before. Writes `basis`.
    """
    settings = job.config.cks
    old = read_basis(job.inputs["basis"]) if "basis" in job.inputs else Basis({}, {})
    checkpoint = Gaussians.read(job.inputs["gaussians"])

    encoder = restored_encoder(checkpoint)
    if not encoder.blocks:
        raise DataFailure("the encoder has no attention weights (train.encoder = mlp); there is no knowledge to carry")
    maps = encoder.linear_maps()
    unfit, wrong = without_basis(maps, old.bases) if old.bases else ([], [])
    if wrong or any(name.startswith("blocks.") for name in old.bases.keys() - maps.keys()):
        raise DataFailure("the basis belongs to an encoder of another depth or width; start another sequence")
    if unfit := [name for name in unfit if name in old.bases]:
        job.left_out(f"knowledge of {', '.join(unfit)}", "this scene's inputs are not those of the basis, which stays")
    sigma = descriptor_spread(job, checkpoint)
    bases: dict[str, Any] = dict(old.bases)
    reports: dict[str, Any] = {}
    for name, W in maps.items():
        if name in unfit:
            continue
        grown, reports[name] = update(
            torch.from_numpy(old.bases[name]) if name in old.bases else None,
            W.detach(),
            Growth(
                energy=settings.energy,
                tolerance=settings.tolerance,
                max_rank=settings.max_rank,
                max_added=settings.max_added,
                n_scenes=settings.n_scenes,
                rule=settings.energy_rule,
                novelty=1 + KAPPA * sigma,
                update_rule=settings.update_rule,
            ),
        )
        bases[name] = grown.numpy()
    weights = {name: value.numpy() for name, value in encoder.state_dict().items()}
    if not old.bases:
        job.left_out("earlier basis", "this is the first scene of its sequence")
    key = read_manifest(job.inputs["gaussians"]).key
    entry = {"scene": job.config.scene.name, "gaussians": key, "spread": sigma, "maps": reports}
    job.facts |= {"revision": old.revision + 1, "ranks": {name: b.shape[1] for name, b in bases.items()}}
    write_basis(job.out, Basis(bases, weights, [*old.lineage, entry]))


def descriptor_spread(job: Job, gaussians: Gaussians) -> float:
    """σ_f of the trained scene (Eq 15), by the regions and descriptors that its last refresh had."""
    trained = trained_with(job.inputs["gaussians"])
    if not trained["train"]["albo"]:
        job.left_out("spread of shape", "train.albo is false: the encoder sees no descriptors")
        return 0.0
    describe = DescribeSection(**trained["describe"])
    means, quats, log_scales = (torch.from_numpy(gaussians.parameters[name]) for name in GEOMETRY)
    regions = regions_of(means.double().numpy(), describe)
    members = torch.from_numpy(regions.members)
    return spread(Descriptors(describe).update(means, quats, log_scales, members), members >= 0)
