"""cks: the next revision of the core knowledge space (Eqs 14-15). The old one is never changed."""

from __future__ import annotations

from typing import Any

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job, command


def run(job: Job) -> None:
    """Extend the knowledge space by what it misses of a scene's encoder (Eq 15; docs/method.md, section 7).

    Reads `gaussians` and, after the first scene of a sequence, the `basis` before. Writes `basis`.
    """
    from chebsplat.formats.artifact import read_manifest
    from chebsplat.formats.basis import Basis, read_basis, write_basis
    from chebsplat.formats.gaussians import read_gaussians
    from chebsplat.stages.restored import restored_encoder

    settings = job.config.cks
    old = read_basis(job.inputs["basis"]) if "basis" in job.inputs else Basis({}, {})
    checkpoint = read_gaussians(job.inputs["gaussians"])
    import torch  # once its inputs are known to be usable

    from chebsplat.shape.cks import update

    encoder = restored_encoder(job.inputs["gaussians"], checkpoint)
    attention = encoder.attention_weights()
    if not attention:
        raise DataFailure("the encoder has no attention weights (train.encoder = mlp); there is no knowledge to carry")
    if old.bases and set(old.bases) != set(attention):
        raise DataFailure("the basis belongs to an encoder of another depth; start another sequence")
    bases: dict[str, Any] = {}
    reports: dict[str, Any] = {}
    for name, weight in attention.items():
        start = torch.from_numpy(old.bases[name]) if name in old.bases else None
        if start is not None and len(start) != len(weight):
            raise DataFailure(f"the basis has {len(start)} rows at {name}, the encoder {len(weight)}")
        grown, report = update(
            start,
            weight.detach(),
            energy=settings.energy,
            tolerance=settings.tolerance,
            max_rank=settings.max_rank,
            rule=settings.energy_rule,
        )
        bases[name] = grown.numpy()
        reports[name] = report
    weights = {name: value.numpy() for name, value in encoder.state_dict().items()}
    if not old.bases:
        job.left_out("earlier basis", "this is the first scene of its sequence")
    key = read_manifest(job.inputs["gaussians"]).key
    entry = {"scene": job.config.scene.name, "gaussians": key, "projections": reports}
    job.facts |= {"revision": old.revision + 1, "ranks": {name: b.shape[1] for name, b in bases.items()}}
    write_basis(job.out, Basis(bases, weights, [*old.lineage, entry]))


main = command("cks", run)
